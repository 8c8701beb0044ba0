#version 330 core
// Draws a picture, one texel per pixel, upright: its row 0 is the upper row, the framebuffer's is the lower.
//
// Reads   picture: final rgb (with background), row 0 on top;
//         left: first column of the picture in the framebuffer, pixels.
// Writes  rgb clamped to 0..1, opaque.

uniform sampler2D picture;
uniform int left;

out vec4 shown;

void main() {
    ivec2 size = textureSize(picture, 0);
    ivec2 pixel = ivec2(gl_FragCoord.xy) - ivec2(left, 0);
    shown = vec4(clamp(texelFetch(picture, ivec2(pixel.x, size.y - 1 - pixel.y), 0).rgb, 0.0, 1.0), 1.0);
}
