// Scene on the GPU: raw (pre-activation) attributes, one texel per Gaussian in each texture, in row-major order.
//
// Reads   the textures below, filled by viewer/gl/scene_textures.py: SPLAT_TEXTURES. A test compares the two.
// Defines `texel_of(splat)`: position of a Gaussian in all of them.

uniform sampler2D mean_logit;     // mean.xyz in world units, logit_opacity
uniform sampler2D log_scale;      // log_scale.xyz: log of standard deviations in world units, unused
uniform sampler2D quat;           // quat.wxyz, any length
uniform sampler2D sh0;            // sh0.rgb, unused

uniform sampler2D shN;            // rgb of one SH coefficient per texel, bands 1 to 3
uniform int sh_coefficients;      // texels per Gaussian in shN: 0, 3, 8 or 15

ivec2 texel_of(uint splat) {
    int row_length = textureSize(mean_logit, 0).x;
    return ivec2(int(splat) % row_length, int(splat) / row_length);
}

vec3 sh_coefficient(ivec2 texel, int k) {
    return texelFetch(shN, ivec2(texel.x * sh_coefficients + k, texel.y), 0).rgb;
}

// Returns true for NaN and infinities. It tests the bits, because drivers may optimize x != x away.
bool not_finite(float value) {
    return (floatBitsToUint(value) & 0x7f800000u) == 0x7f800000u;
}

bool not_finite(vec3 value) {
    return not_finite(value.x) || not_finite(value.y) || not_finite(value.z);
}
