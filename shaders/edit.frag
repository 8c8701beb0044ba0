#version 330 core
// The edited attributes of one Gaussian: all but the higher SH bands, which edit_sh.frag writes.
//
// Reads   the stack of edits (include/edit_layers.glsl), and where the original attributes lie.
// Writes  raw attributes into the scene's textures (include/raw_splats.glsl: mean_logit, log_scale, quat, sh0), one
//         texel a Gaussian in each; components that nothing moves get the bits of the original.

#include "include/edit_layers.glsl"

flat in int first_column;
flat in int first_slot;

uniform ivec4 originals;   // for each target, where in `edit_floats` its original texels begin, by slot
uniform ivec4 wanted;      // targets that are written; the others are masked

layout(location = 0) out vec4 mean_logit;
layout(location = 1) out vec4 log_scale;
layout(location = 2) out vec4 quat;
layout(location = 3) out vec4 sh0;

void main() {
    int slot = first_slot + int(gl_FragCoord.x) - first_column;
    vec4 total[4] = vec4[4](nothing(), nothing(), nothing(), nothing());
    bvec4 moved[4] = bvec4[4](bvec4(false), bvec4(false), bvec4(false), bvec4(false));
    float crowd = 0.0;
    for (int layer = 0; layer < layer_count; layer++) {
        Part part = part_of(layer, slot);
        if (part.member < 0) continue;
        crowd += part.share * part.cover;
        for (int target = 0; target < 4; target++) {
            if (wanted[target] != 0) add(total[target], moved[target], part, layer, target, 1, 0);
        }
    }
    vec4 found[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
    for (int target = 0; target < 4; target++) {
        if (wanted[target] == 0) continue;
        vec4 original = texelFetch(edit_floats, texel_at(originals[target] + slot), 0);
        found[target] = finished(original, total[target], moved[target], crowd);
    }
    mean_logit = found[0];
    log_scale = found[1];
    quat = found[2];
    sh0 = found[3];
}
