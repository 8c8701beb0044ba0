#version 330 core
// Draws a picture upright and scaled with linear filtering, for reduced resolution while the view changes.
//
// Reads   picture: final rgb (with background), row 0 on top, filtered linearly;
//         shown_size: width and height of the covered part of the framebuffer, pixels;
//         left: first column of that part, pixels.
// Writes  rgb clamped to 0..1, opaque.

uniform sampler2D picture;
uniform vec2 shown_size;
uniform int left;

out vec4 shown;

void main() {
    vec2 half_texel = 0.5 / vec2(textureSize(picture, 0));
    vec2 at = (gl_FragCoord.xy - vec2(left, 0)) / shown_size;
    at = clamp(vec2(at.x, 1.0 - at.y), half_texel, 1.0 - half_texel);
    shown = vec4(clamp(texture(picture, at).rgb, 0.0, 1.0), 1.0);
}
