#version 330 core
// A line of the grid on the ground: a strip of two triangles in the plane of the picture, as wide everywhere.
//
// Reads   gl_InstanceID: the line, first those along `ahead`, then those along `across`; gl_VertexID: its corner;
//         middle, across, ahead: the grid's middle and the sides of a cell, in the camera's axes (x right, y down,
//         z forward), world units; first: the middle, cells from the world's origin; lines: to either side of it;
//         nearest: least depth; intrinsics: fx, fy, cx, cy of the part of the framebuffer that is drawn in, pixels;
//         shown_size: its width and height; ink, across_ink, ahead_ink: colors of the lines, and of the two
//         through the origin.
// Writes  gl_Position; from_line: distance from the middle of the line, pixels; cell: place in the grid, its half
//         side is 1; color: of the line, with its share; half_width: pixels.

uniform vec3 middle, across, ahead;
uniform ivec2 first;
uniform int lines;
uniform float nearest;
uniform vec4 intrinsics;
uniform vec2 shown_size;
uniform vec4 ink;
uniform vec3 across_ink, ahead_ink;

noperspective out float from_line;
out vec2 cell;
flat out vec4 color;
flat out float half_width;

const int EVERY = 10;   // lines there is a stronger one

vec2 to_pixels(vec3 at) { return intrinsics.xy * at.xy / at.z + intrinsics.zw; }

void main() {
    int count = 2 * lines + 1;
    bool sideways = gl_InstanceID >= count;   // along `across`
    int step = gl_InstanceID % count - lines;
    int number = step + (sideways ? first.y : first.x);
    vec2 a = vec2(step, -lines), b = vec2(step, lines);
    if (sideways) { a = a.yx; b = b.yx; }
    vec3 from = middle + a.x * across + a.y * ahead, to = middle + b.x * across + b.y * ahead;
    if (from.z < nearest && to.z < nearest) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
    if (from.z < nearest) {
        float part = (nearest - from.z) / (to.z - from.z);
        from = mix(from, to, part); a = mix(a, b, part);
    } else if (to.z < nearest) {
        float part = (nearest - to.z) / (from.z - to.z);
        to = mix(to, from, part); b = mix(b, a, part);
    }
    vec2 start = to_pixels(from), end = to_pixels(to), along = end - start;
    float far = length(along);
    along = far > 1e-6 ? along / far : vec2(1.0, 0.0);
    bool strong = number % EVERY == 0;
    half_width = strong ? 0.8 : 0.5;
    color = ink * vec4(1.0, 1.0, 1.0, strong ? 1.5 : 1.0);
    vec3 own = sideways ? across_ink : ahead_ink;
    if (number == 0 && own != vec3(0.0)) color = vec4(own, 2.2 * ink.a);
    bool last = (gl_VertexID & 1) == 1;
    from_line = (half_width + 1.0) * ((gl_VertexID & 2) == 0 ? -1.0 : 1.0);
    vec3 at = last ? to : from;
    cell = (last ? b : a) / float(lines);
    vec2 pixel = (last ? end : start) + from_line * vec2(-along.y, along.x);
    vec2 clip = 2.0 * pixel / shown_size - 1.0;
    gl_Position = vec4(clip.x * at.z, -clip.y * at.z, 0.0, at.z);
}
