#version 330 core
// The color of one Gaussian with its outline at one pixel, for blending back to front.
//
// Reads   as in splat.frag.
// Writes  as in splat.frag. Nothing is drawn outside of the outline; see progdf/rasterize/cpu/rings.py.

#include "include/conventions.glsl"

flat in vec2 splat_center;
flat in vec3 splat_shape;
flat in float splat_r2;
flat in vec4 splat_rgb_opacity;

out vec4 premultiplied;

const float CONTOUR2 = 2.8853900817779268;   // u² + v² at the outline, two standard deviations
const float RING_ALPHA = 0.6;                // alpha of the outline
const float RING_PX = 1.5;                   // its width, pixels
const float LINE_CONTRAST = 0.4;             // share of black or white in its color

void main() {
    vec2 d = gl_FragCoord.xy - splat_center;
    float u = splat_shape.y * (d.x + splat_shape.x * d.y);
    float v = splat_shape.z * d.y;
    float q = u * u + v * v;
    float contour = min(splat_r2, CONTOUR2);
    if (q > contour) discard;
    vec2 slope = 2.0 * vec2(u * splat_shape.y, u * splat_shape.y * splat_shape.x + v * splat_shape.z);
    float inside = (contour - q) / max(length(slope), 1e-6);     // distance to the outline, pixels
    float ring = RING_ALPHA * clamp(RING_PX - inside, 0.0, 1.0);
    float fill = min(ALPHA_MAX, splat_rgb_opacity.a * exp2(-q));
    float alpha = fill + ring * (1.0 - fill);
    vec3 rgb = splat_rgb_opacity.rgb;
    vec3 line = mix(rgb, vec3(rgb.r + rgb.g + rgb.b < 1.5 ? 1.0 : 0.0), LINE_CONTRAST);
    premultiplied = vec4(line * ring + rgb * (alpha - ring), alpha);
}
