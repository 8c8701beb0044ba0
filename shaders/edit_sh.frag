#version 330 core
// One edited coefficient of the higher SH bands of one Gaussian.
//
// Reads   the stack of edits (include/edit_layers.glsl), and where the original coefficients lie.
// Writes  rgb of the coefficient into the scene's texture shN (include/raw_splats.glsl), `sh_coefficients` texels a
//         Gaussian.

#include "include/edit_layers.glsl"

flat in int first_column;  // in Gaussians, as in edit.vert
flat in int first_slot;

uniform int original;         // where in `edit_floats` the original coefficients begin, by slot and coefficient
uniform int sh_coefficients;  // 3, 8 or 15

layout(location = 0) out vec4 shN;

const int SH_TARGET = 4;

void main() {
    int texel = int(gl_FragCoord.x);
    int slot = first_slot + texel / sh_coefficients - first_column;
    int column = texel % sh_coefficients;
    vec4 total = nothing();
    bvec4 moved = bvec4(false);
    float crowd = 0.0;
    for (int layer = 0; layer < layer_count; layer++) {
        Part part = part_of(layer, slot);
        if (part.member < 0) continue;
        crowd += part.share * part.cover;
        add(total, moved, part, layer, SH_TARGET, sh_coefficients, column);
    }
    vec4 before = texelFetch(edit_floats, texel_at(original + slot * sh_coefficients + column), 0);
    shN = finished(before, total, moved, crowd);
}
