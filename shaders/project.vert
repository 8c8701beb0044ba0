#version 330 core
// Projects one Gaussian, once a frame; the results go to a buffer (transform feedback).
//
// Reads   splat: which Gaussian, in drawing order (farthest first); the scene and the camera, see include/project.glsl.
// Writes  viewer/gl/scene_textures.py: PROJECTED, as include/project.glsl has it.

in uint splat;

out vec2 center;
out vec3 shape;              // slope, l11, l22
out float r2;
out vec4 rgb_opacity;

#include "include/project.glsl"

void main() {
    gl_Position = vec4(0.0);
    project(splat);
}
