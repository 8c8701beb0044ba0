#version 330 core
// Draws a line of the ground grid: a strip of two triangles in the picture plane, of constant width.
//
// Reads   per line GRID_LINE of viewer/gl/scene_textures.py; gl_VertexID: its corner; picture: for its size.
// Writes  gl_Position; from_line: distance from the middle of the line, pixels; cell: position in the grid, where
//         lines are invisible from 1 on; ink: color of the line, and its opacity.

in vec4 ends;
in vec2 depths;
in vec4 cells;
in vec4 color;

uniform sampler2D picture;

noperspective out float from_line;
out vec2 cell;
flat out vec4 ink;

void main() {
    vec2 along = ends.zw - ends.xy;
    float far = length(along);
    along = far > 1e-6 ? along / far : vec2(1.0, 0.0);
    bool last = (gl_VertexID & 1) == 1;
    from_line = (gl_VertexID & 2) == 0 ? -1.0 : 1.0;
    cell = last ? cells.zw : cells.xy;
    ink = color;
    vec2 pixel = (last ? ends.zw : ends.xy) + from_line * vec2(-along.y, along.x);
    vec2 clip = 2.0 * pixel / vec2(textureSize(picture, 0)) - 1.0;
    float depth = last ? depths.y : depths.x;
    gl_Position = vec4(clip.x * depth, -clip.y * depth, 0.0, depth);
}
