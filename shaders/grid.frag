#version 330 core
// Draws a line of the ground grid behind the splats of a picture that is already drawn.
//
// Reads   from grid.vert; picture: its alpha is the scene's opacity coverage of each pixel, row 0 on top;
//         shown_size, left: width and height of the drawn part of the framebuffer, and its first column, pixels.
// Writes  rgb, and the line's share of the pixel.

uniform sampler2D picture;
uniform vec2 shown_size;
uniform int left;

noperspective in float from_line;
in vec2 cell;
flat in vec4 ink;

out vec4 shown;

const float CLEAR = 0.3;   // radius within which lines do not fade; same as viewer/render/ground_grid.py

void main() {
    float line = clamp(1.0 - abs(from_line), 0.0, 1.0);
    float fade = clamp((1.0 - length(cell)) / (1.0 - CLEAR), 0.0, 1.0);
    vec2 at = (gl_FragCoord.xy - vec2(left, 0)) / shown_size;
    float through = 1.0 - texture(picture, vec2(at.x, 1.0 - at.y)).a;
    shown = vec4(ink.rgb, clamp(ink.a * line * fade * through, 0.0, 1.0));
}
