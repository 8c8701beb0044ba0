#version 330 core
// Shows a picture upright: its row 0 is the upper row, the framebuffer's is the lower. Texel by pixel where
// it is shown in its own size, else interpolated.
//
// Reads   picture: rgb as it shall be shown (background already behind it), row 0 on top;
//         shown_size: width and height of the part of the framebuffer that it fills, pixels.
// Writes  rgb clamped to 0..1, opaque.

uniform sampler2D picture;
uniform ivec2 shown_size;

out vec4 shown;

vec3 texel(ivec2 at, ivec2 size) {
    return clamp(texelFetch(picture, clamp(at, ivec2(0), size - 1), 0).rgb, 0.0, 1.0);
}

void main() {
    ivec2 size = textureSize(picture, 0);
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    pixel.y = shown_size.y - 1 - pixel.y;
    if (size == shown_size) {
        shown = vec4(texel(pixel, size), 1.0);
        return;
    }
    vec2 at = (vec2(pixel) + 0.5) * vec2(size) / vec2(shown_size) - 0.5;
    ivec2 corner = ivec2(floor(at));
    vec2 share = at - vec2(corner);
    vec3 upper = mix(texel(corner, size), texel(corner + ivec2(1, 0), size), share.x);
    vec3 lower = mix(texel(corner + ivec2(0, 1), size), texel(corner + ivec2(1, 1), size), share.x);
    shown = vec4(mix(upper, lower, share.y), 1.0);
}
