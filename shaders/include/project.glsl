// Projects one Gaussian and evaluates its color, from the raw scene.
//
// Reads   the uniforms below: OpenCV axes (x right, y down, z forward), lengths in world units, intrinsics in pixels.
// Defines `project(splat)`, which writes the stage's own `center`, `shape`, `r2` and `rgb_opacity`, in pixels of the
//         picture, x right and y down from the upper left corner:
//         alpha(d) = opacity · 2^−(u² + v²), u = l11 · (d.x + slope · d.y), v = l22 · d.y, d = pixel − center.
//         r2 is u² + v² at alpha = 1/255, and negative if nothing is to be drawn.
//
// All values are float32, so nothing may cancel. The camera's center comes in two parts, and the determinant of the
// 2D covariance is a sum of squares. All lengths are relative to the size of the Gaussian, so neither needles of
// 1e6:1 nor scales of 1e18 overflow or underflow.

#include "include/conventions.glsl"
#include "include/raw_splats.glsl"
#include "include/sh.glsl"

uniform mat3 rotation;       // world → camera, column vectors
uniform vec3 eye_high;       // the camera's center, world units, rounded to float32 …
uniform vec3 eye_low;        // … and the remainder of the rounding
uniform vec4 intrinsics;     // fx, fy, cx, cy
uniform vec2 size;           // width, height
uniform bool antialiased;    // opacity × sqrt(det before dilation / det after)
uniform bool activated;      // the logits are opacities, which may exceed 1
uniform float dot_px;        // above 0: dots with this standard deviation in pixels, in place of the Gaussians
uniform bool highlighted;         // true if `highlight` is set
uniform sampler2D highlight;      // rgb, and its share in the Gaussian's color; 1 hides the Gaussian

const float UNIT = 0.8493218002880191;   // sqrt(log2(e) / 2): u and v per standard deviation

mat3 rotation_of(vec4 wxyz) {
    float largest = max(max(abs(wxyz.x), abs(wxyz.y)), max(abs(wxyz.z), abs(wxyz.w)));
    if (largest == 0.0 || not_finite(wxyz.x) || not_finite(wxyz.yzw)) return mat3(1.0);
    vec4 q = wxyz / largest;             // keeps squares of 1e-30 and 1e30 in range
    q /= length(q);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void project(uint splat) {
    center = vec2(0.0);
    shape = vec3(0.0, 1.0, 1.0);
    r2 = -1.0;
    rgb_opacity = vec4(0.0);

    ivec2 texel = texel_of(splat);
    vec4 mean_and_logit = texelFetch(mean_logit, texel, 0);
    vec3 log_scales = texelFetch(log_scale, texel, 0).xyz;
    float logit = mean_and_logit.w;
    bool logit_is_nan = not_finite(logit) && (floatBitsToUint(logit) & 0x007fffffu) != 0u;
    // −inf is a scale of 0, which may be drawn; from 88.7 on the scale is infinite
    bool scales_are_bad = !all(lessThanEqual(log_scales, vec3(88.7)));
    vec3 offset = (mean_and_logit.xyz - eye_high) - eye_low;
    if (logit_is_nan || scales_are_bad || not_finite(offset)) return;

    float opacity = activated ? logit : 1.0 / (1.0 + exp(-clamp(logit, -80.0, 80.0)));
    vec3 p = rotation * offset;
    if (opacity < ALPHA_MIN || p.z <= 0.0) return;
    if (dot_px > 0.0) {
        log_scales = vec3(log(p.z * dot_px / max(intrinsics.x, intrinsics.y)));
        opacity = 1.0;
    }

    // clamp like the original (Kerbl 2023, computeCov2D): off-screen Gaussians would blow up the Jacobian
    vec2 focal = intrinsics.xy, principal = intrinsics.zw;
    vec2 margin = FRUSTUM_MARGIN * 0.5 * size / focal;
    vec2 tangent = clamp(p.xy / p.z, -(principal / focal + margin), (size - principal) / focal + margin);

    // axes of the Gaussian along the image's x and y: first unit lengths, then scales in units of `unit_px`
    mat3 to_gaussian = transpose(rotation_of(texelFetch(quat, texel, 0))) * transpose(rotation);
    vec2 px_per_unit = focal / p.z;
    // larger scales change nothing on any screen, and squares stay in range
    vec3 scales_px = min(exp(max(log_scales, vec3(-1e4))) * max(px_per_unit.x, px_per_unit.y), vec3(1e18));
    float unit_px = max(1.0, max(scales_px.x, max(scales_px.y, scales_px.z)));
    vec3 s = scales_px / unit_px;
    vec2 squeeze = px_per_unit / max(px_per_unit.x, px_per_unit.y);
    vec3 p0 = squeeze.x * (to_gaussian * vec3(1.0, 0.0, -tangent.x)) * s;
    vec3 p1 = squeeze.y * (to_gaussian * vec3(0.0, 1.0, -tangent.y)) * s;
    // |p0 × p1|² without its cancellation: the cross product of the image axes is the view ray (tangent, 1)
    vec3 area = squeeze.x * squeeze.y * (to_gaussian * vec3(tangent, 1.0)) * s.yzx * s.zxy;
    float dilation = DILATION / (unit_px * unit_px);
    float a = dot(p0, p0), b = dot(p0, p1), c = dot(p1, p1), det0 = dot(area, area);
    float det = det0 + dilation * (a + c) + dilation * dilation;
    if (antialiased) opacity *= sqrt(max(ANTIALIAS_FLOOR, det0 / det));
    if (opacity < ALPHA_MIN) return;
    float reach2 = max(0.0, log2(opacity / ALPHA_MIN));
    vec2 at = focal * p.xy / p.z + principal;
    vec2 extent = sqrt(reach2 * (vec2(a, c) + dilation)) * (unit_px / UNIT);
    if (any(greaterThan(at - extent, size)) || any(lessThan(at + extent, vec2(0.0)))) return;

    vec3 rgb = shade(texel, offset / length(offset));
    if (highlighted) {
        vec4 over = texelFetch(highlight, texel, 0);
        if (over.a == 1.0) return;
        rgb = mix(rgb, over.rgb, over.a);
    }
    if (not_finite(rgb)) return;        // before the clamp, which hides NaN and -inf
    center = at;
    shape = vec3(-b / (c + dilation), UNIT * sqrt((c + dilation) / det) / unit_px,
                 UNIT * inversesqrt(c + dilation) / unit_px);
    r2 = reach2;
    rgb_opacity = vec4(max(rgb, 0.0), opacity);
}
