#version 330 core
// Covers a span of texels that belong to Gaussians which follow each other: an instance is a span, a vertex one of
// the four corners of a triangle strip.
//
// Reads   span: viewer/gl/layout.py: SPAN; texel positions count from the texture's first row.
// Writes  gl_Position in clip space, and for every fragment the span's first column and the slot of its first
//         Gaussian (see include/edit_layers.glsl).

in ivec4 span;             // column and row of its first texel, texels, slot of the first

uniform ivec2 size;        // of the texture: Gaussians a row, rows

flat out int first_column;
flat out int first_slot;

void main() {
    first_column = span.x;
    first_slot = span.w;
    vec2 corner = vec2(span.xy) + vec2((gl_VertexID & 1) * span.z, gl_VertexID >> 1);
    gl_Position = vec4(2.0 * corner / vec2(size) - 1.0, 0.0, 1.0);
}
