#version 330 core
// One triangle around one projected Gaussian: an instance is a Gaussian, a vertex one of three corners.
//
// Reads   viewer/gl/scene_textures.py: PROJECTED (see project.vert), in pixels of the picture, y down.
// Writes  gl_Position and the inputs of splat.frag, see include/corner.glsl.

in vec2 center;
in vec3 shape;
in float r2;
in vec4 rgb_opacity;

uniform vec2 size;           // width, height of the picture in pixels

#include "include/corner.glsl"

void main() {
    place_corner(gl_VertexID % 3);
}
