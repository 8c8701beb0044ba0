#version 330 core
// Covers the whole viewport with one triangle.
//
// Reads   nothing: the corners come from gl_VertexID.
// Writes  gl_Position in clip space.

void main() {
    gl_Position = vec4(vec2[3](vec2(-1.0, -1.0), vec2(3.0, -1.0), vec2(-1.0, 3.0))[gl_VertexID], 0.0, 1.0);
}
