#version 330 core
// The color of one Gaussian at one pixel, for blending back to front.
//
// Reads   one projected Gaussian (see project.vert) and the pixel's center, in pixels of the picture.
// Writes  premultiplied rgb and alpha, linear, 0..1; blended as source + (1 − source alpha) · destination.

#include "include/conventions.glsl"

flat in vec2 splat_center;
flat in vec3 splat_shape;
flat in float splat_r2;
flat in vec4 splat_rgb_opacity;

out vec4 premultiplied;

void main() {
    // from gl_FragCoord, because interpolated corners lose 11 dB
    vec2 d = gl_FragCoord.xy - splat_center;
    float u = splat_shape.y * (d.x + splat_shape.x * d.y);
    float v = splat_shape.z * d.y;
    float q = u * u + v * v;
    if (q > splat_r2) discard;           // alpha < ALPHA_MIN
    float alpha = min(ALPHA_MAX, splat_rgb_opacity.a * exp2(-q));
    premultiplied = vec4(splat_rgb_opacity.rgb * alpha, alpha);
}
