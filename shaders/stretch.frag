#version 330 core
// Shows a picture upright in another size than its own, smoothly: while something moves, few pixels fill many.
//
// Reads   picture: rgb as it shall be shown (background already behind it), row 0 on top, filtered linearly;
//         shown_size: width and height of the part of the framebuffer that it fills, pixels;
//         left: the column at which that begins.
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
