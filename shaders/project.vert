#version 330 core
// Projects one Gaussian, once per frame. The results go to a buffer (transform feedback).
//
// Reads   splat: index of the Gaussian, in drawing order (farthest first); the scene and the camera, see
//         include/project.glsl; the view mode, see include/view_modes.glsl.
// Writes  viewer/gl/scene_textures.py: PROJECTED, as in include/project.glsl.

in uint splat;

out vec2 center;
out vec3 shape;              // slope, l11, l22
out float r2;
out vec4 rgb_opacity;

#include "include/project.glsl"
#include "include/view_modes.glsl"

void main() {
    gl_Position = vec4(0.0);
    project(splat);
    if (r2 < 0.0 || view_mode == 0) return;
    rgb_opacity.rgb = mode_color(splat);
    if (highlighted) {
        vec4 over = texelFetch(highlight, texel_of(splat), 0);
        rgb_opacity.rgb = mix(rgb_opacity.rgb, over.rgb, over.a);
    }
}
