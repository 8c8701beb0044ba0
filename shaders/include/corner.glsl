// One triangle around one projected Gaussian, for splat.frag.
//
// Needs the stage's `center`, `shape`, `r2` and `rgb_opacity` (see include/project.glsl) and `size`.
// Defines `place_corner(corner)`, 0 to 2, which writes gl_Position in clip space. Picture y down is clip y up, so
// row 0 of the framebuffer is the picture's first row and gl_FragCoord.xy is the pixel position itself.

flat out vec2 splat_center;
flat out vec3 splat_shape;
flat out float splat_r2;
flat out vec4 splat_rgb_opacity;

// The smallest triangle around the unit circle. It has 1.65 times the circle's area, and shades a quarter fewer
// pixels than a square of two triangles, whose common edge is shaded twice in 2x2 blocks.
const vec2 CORNERS[3] = vec2[3](vec2(-1.7320508, -1.0), vec2(1.7320508, -1.0), vec2(0.0, 2.0));
const float LARGEST = 16384.0;   // px; beyond it float32 corners are not exact to a pixel: cover the whole picture

void place_corner(int corner_index) {
    splat_center = center;
    splat_shape = shape;
    splat_r2 = r2;
    splat_rgb_opacity = rgb_opacity;
    if (r2 < 0.0) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
    // slightly larger, so that rounding of the corners loses no pixel center at the edge
    vec2 uv = CORNERS[corner_index] * (sqrt(r2) * 1.0001 + 0.03);
    float dy = uv.y / shape.z;
    vec2 corner = center + vec2(uv.x / shape.y - shape.x * dy, dy);
    float reach = length(center) + (sqrt(r2) + 0.03) * (1.0 / shape.y + (1.0 + abs(shape.x)) / shape.z);
    if (!(reach < LARGEST)) {
        corner = size * vec2[3](vec2(0.0, 0.0), vec2(2.0, 0.0), vec2(0.0, 2.0))[corner_index];
    }
    gl_Position = vec4(2.0 * corner / size - 1.0, 0.0, 1.0);
}
