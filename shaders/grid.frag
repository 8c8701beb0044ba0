#version 330 core
// A line of the grid on the ground, behind the splats of a picture that is already there.
//
// Reads   from grid.vert; coverage: what the scene covers of each pixel, in alpha, row 0 on top;
//         shown_size, left: width and height of the part of the framebuffer that is drawn in, and its first column.
// Writes  rgb, and the share of the pixel that it takes.

uniform sampler2D coverage;
uniform vec2 shown_size;
uniform int left;

noperspective in float from_line;
in vec2 cell;
flat in vec4 color;
flat in float half_width;

out vec4 shown;

void main() {
    float line = clamp(half_width + 0.5 - abs(from_line), 0.0, 1.0);
    float fade = 1.0 - smoothstep(0.35, 1.0, length(cell));
    vec2 at = (gl_FragCoord.xy - vec2(left, 0)) / shown_size;
    float through = 1.0 - texture(coverage, vec2(at.x, 1.0 - at.y)).a;
    shown = vec4(color.rgb, clamp(color.a * line * fade * through, 0.0, 1.0));
}
