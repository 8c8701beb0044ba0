#version 330 core
// A line of the grid on the ground, behind the splats of a picture that is already there.
//
// Reads   from grid.vert; picture: its alpha is what the scene covers of each pixel, row 0 on top;
//         shown_size, left: width and height of the part of the framebuffer that is drawn in, and its first column.
// Writes  rgb, and the share of the pixel that it takes.

uniform sampler2D picture;
uniform vec2 shown_size;
uniform int left;

noperspective in float from_line;
in vec2 cell;
flat in vec4 ink;

out vec4 shown;

const float CLEAR = 0.3;   // within which the lines have not begun to fade; as viewer/render/ground_grid.py

void main() {
    float line = clamp(1.0 - abs(from_line), 0.0, 1.0);
    float fade = clamp((1.0 - length(cell)) / (1.0 - CLEAR), 0.0, 1.0);
    vec2 at = (gl_FragCoord.xy - vec2(left, 0)) / shown_size;
    float through = 1.0 - texture(picture, vec2(at.x, 1.0 - at.y)).a;
    shown = vec4(ink.rgb, clamp(ink.a * line * fade * through, 0.0, 1.0));
}
