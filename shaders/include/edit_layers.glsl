// A stack of edits, for one Gaussian: Σ or "over" of share · gain · (factor₀ · full + Σ factor_k · basis_k), as
// progdf/compose/reference.py states it.
//
// Reads the textures below, lists of texels in rows of TEXELS_PER_ROW, filled by viewer/gl/edit_packing.py, edits
//         once, the stack with every new strength; a test compares the layout with viewer/gl/layout.py.
// Gives `part_of(layer, slot)`: what a layer has to do with a Gaussian; `add(...)`: its offsets, laid on those of the
//         layers below; `finished(...)`: the sum on top of the original.
//
// A slot counts the Gaussians that are a member of any edit; a target is one of the textures that are written.

uniform sampler2D edit_floats;    // original attributes; full offsets; what is covered; bases that are kept as floats
uniform isampler2D edit_levels;   // bases that are kept as int8
uniform isampler2D edit_places;   // which member of an edit a slot is, −1 where it is none
uniform sampler2D edit_weights;   // painted strength of a layer's members, 0..1
uniform isampler2D edit_layers;   // LAYER_TEXELS a layer: places, weights, numbers, covers; then full, rest, rank, numbers
                                  // for every target. Indices of texels. weights −1: all are 1; rest −1: bases 1 to
                                  // rank follow the full offset; numbers −1: the layer does not move this target
uniform sampler2D edit_numbers;   // of a layer: cover, –, –, –; of its targets: gain, then factor₀ … factor_rank
uniform int layer_count;          // lowest layer first
uniform int blend;                // index into progdf.compose.layers.BLENDS

const int TEXELS_PER_ROW = 4096;
const int LAYER_TEXELS = 6;
const int NORMALIZED = 0, SUM = 1, OVER = 2;

struct Part {
    int member;    // −1: none
    float share;   // painted strength, 0..1
    float cover;   // strength without its overshoot, 0..1
    vec4 hides;    // of geometry, opacity and color (progdf/compose/coverage.py), 0..1; only where blend is OVER
};

ivec2 texel_at(int index) {
    uint at = uint(index);   // unsigned: a power of two is then a mask and a shift
    return ivec2(at % uint(TEXELS_PER_ROW), at / uint(TEXELS_PER_ROW));
}

Part part_of(int layer, int slot) {
    ivec4 begins = texelFetch(edit_layers, texel_at(LAYER_TEXELS * layer), 0);
    int member = texelFetch(edit_places, texel_at(begins.x + slot), 0).x;
    float share = 1.0;
    if (member >= 0 && begins.y >= 0) share = texelFetch(edit_weights, texel_at(begins.y + member), 0).x;
    if (share == 0.0) member = -1;
    vec4 hides = vec4(0.0);
    if (member >= 0 && blend == OVER) hides = texelFetch(edit_floats, texel_at(begins.w + member), 0);
    return Part(member, share, texelFetch(edit_numbers, texel_at(begins.z), 0).x, hides);
}

// Lays one layer on top of `total`.
//
// target: which of the textures; width: texels a Gaussian in it; column: which of them.
// moved: components that have an offset so far; the others keep the bits of the original.
void add(inout vec4 total, inout bvec4 moved, Part part, int layer, int target, int width, int column) {
    ivec4 bases = texelFetch(edit_layers, texel_at(LAYER_TEXELS * layer + 1 + target), 0);
    if (bases.w < 0) return;
    bool as_floats = bases.y < 0;
    int entry = part.member * width + column;
    int full = bases.x + (as_floats ? entry * (1 + bases.z) : entry);
    int factors = bases.w + 1 + column;
    vec4 offset = texelFetch(edit_numbers, texel_at(factors), 0) * texelFetch(edit_floats, texel_at(full), 0);
    for (int k = 0; k < bases.z; k++) {
        vec4 factor = texelFetch(edit_numbers, texel_at(factors + (1 + k) * width), 0);
        if (factor == vec4(0.0)) continue;   // of many keyframes, all but two; at both ends, all
        if (as_floats) {
            offset += factor * texelFetch(edit_floats, texel_at(full + 1 + k), 0);
        } else {
            offset += factor * vec4(texelFetch(edit_levels, texel_at(bases.y + entry * bases.z + k), 0));
        }
    }
    vec4 gain = texelFetch(edit_numbers, texel_at(bases.w), 0);
    if (blend == OVER) {
        vec4 hides = target == 0 ? part.hides.xxxy : target < 3 ? part.hides.xxxx : part.hides.zzzz;
        total *= 1.0 - part.share * part.cover * min(abs(gain), 1.0) * hides;
    }
    bvec4 moves = notEqual(gain, vec4(0.0));   // a gain of 0 leaves every bit; 0 · offset might not
    total = mix(total, total + (part.share * gain) * offset, moves);
    moved = bvec4(moved.x || moves.x, moved.y || moves.y, moved.z || moves.z, moved.w || moves.w);
}

// Nothing yet: −0, which added to any other number leaves every bit as it was.
vec4 nothing() {
    return vec4(uintBitsToFloat(0x80000000u));
}

// crowd: Σ share · cover of the layers.
vec4 finished(vec4 original, vec4 total, bvec4 moved, float crowd) {
    if (blend == NORMALIZED && crowd > 1.0) total /= crowd;
    return mix(original, original + total, moved);
}
