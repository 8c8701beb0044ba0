// Colors of the view modes depth, normals and opacity, as in viewer/render/view_modes.py.
//
// Needs include/project.glsl.
// Defines `mode_color(splat)`: rgb of a Gaussian in `view_mode`, 0..1.

uniform int view_mode;       // 1: depth, 2: normals, 3: opacity; others keep the Gaussian's own color
uniform vec2 depth_range;    // depths of the near and far end of the ramp, world units
uniform vec3 ramp[5];        // colors at 0, 1/4, 1/2, 3/4 and 1

vec3 ramp_color(float share) {
    float at = clamp(share, 0.0, 1.0) * 4.0;
    int low = min(int(at), 3);
    return mix(ramp[low], ramp[low + 1], at - float(low));
}

vec3 mode_color(uint splat) {
    ivec2 texel = texel_of(splat);
    vec4 mean_and_logit = texelFetch(mean_logit, texel, 0);
    vec3 p = rotation * ((mean_and_logit.xyz - eye_high) - eye_low);
    if (view_mode == 1) return ramp_color((depth_range.y - p.z) / (depth_range.y - depth_range.x));
    if (view_mode == 3) return ramp_color(1.0 / (1.0 + exp(-clamp(mean_and_logit.w, -80.0, 80.0))));
    vec3 s = texelFetch(log_scale, texel, 0).xyz;
    int shortest = s.x <= s.y ? (s.x <= s.z ? 0 : 2) : (s.y <= s.z ? 1 : 2);
    vec3 normal = rotation * rotation_of(texelFetch(quat, texel, 0))[shortest];
    if (dot(normal, p) > 0.0) normal = -normal;
    return 0.5 + 0.5 * normal * vec3(1.0, -1.0, -1.0);
}
