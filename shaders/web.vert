#version 330 core
// Combines project.vert and splat.vert for WebGL: three consecutive vertices are the triangle of one Gaussian.
//
// Reads   order: indices of the Gaussians in drawing order (farthest first), in row-major order; the scene and the
//         camera, see include/project.glsl; depths: true to draw the depth in place of the color.
// Writes  gl_Position and the inputs of splat.frag, see include/corner.glsl.

vec2 center;
vec3 shape;                  // slope, l11, l22
float r2;
vec4 rgb_opacity;

#include "include/project.glsl"
#include "include/corner.glsl"

uniform highp usampler2D order;
uniform bool depths;

void main() {
    int at = gl_VertexID / 3, row_length = textureSize(order, 0).x;
    uint splat = texelFetch(order, ivec2(at % row_length, at / row_length), 0).r;
    project(splat);
    if (depths) {
        vec3 offset = texelFetch(mean_logit, texel_of(splat), 0).xyz - eye_high - eye_low;
        rgb_opacity.rgb = vec3((rotation * offset).z);
    }
    place_corner(gl_VertexID % 3);
}
