// Color from real spherical harmonics, with the signs and order of the 3DGS .ply file, as in progdf/sh.py.
//
// Needs include/raw_splats.glsl.
// Defines `shade(texel, direction)`: rgb before the clamp at 0, seen along `direction`, a unit vector from the
// camera's center to the Gaussian in world axes.

const float SH_C0 = 0.28209479177387814;
const float SH_C1 = 0.4886025119029199;

vec3 shade(ivec2 texel, vec3 direction) {
    vec3 rgb = 0.5 + SH_C0 * texelFetch(sh0, texel, 0).rgb;
    float x = direction.x, y = direction.y, z = direction.z;
    if (sh_coefficients >= 3) {
        rgb += SH_C1 * (z * sh_coefficient(texel, 1) - y * sh_coefficient(texel, 0) - x * sh_coefficient(texel, 2));
    }
    float xx = x * x, yy = y * y, zz = z * z;
    if (sh_coefficients >= 8) {
        rgb += 1.0925484305920792 * x * y * sh_coefficient(texel, 3);
        rgb += -1.0925484305920792 * y * z * sh_coefficient(texel, 4);
        rgb += 0.31539156525252005 * (2.0 * zz - xx - yy) * sh_coefficient(texel, 5);
        rgb += -1.0925484305920792 * x * z * sh_coefficient(texel, 6);
        rgb += 0.5462742152960396 * (xx - yy) * sh_coefficient(texel, 7);
    }
    if (sh_coefficients >= 15) {
        rgb += -0.5900435899266435 * y * (3.0 * xx - yy) * sh_coefficient(texel, 8);
        rgb += 2.890611442640554 * x * y * z * sh_coefficient(texel, 9);
        rgb += -0.4570457994644658 * y * (4.0 * zz - xx - yy) * sh_coefficient(texel, 10);
        rgb += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh_coefficient(texel, 11);
        rgb += -0.4570457994644658 * x * (4.0 * zz - xx - yy) * sh_coefficient(texel, 12);
        rgb += 1.445305721320277 * z * (xx - yy) * sh_coefficient(texel, 13);
        rgb += -0.5900435899266435 * x * (xx - 3.0 * yy) * sh_coefficient(texel, 14);
    }
    return rgb;
}
