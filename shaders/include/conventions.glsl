// The numbers that every engine agrees on: progdf/rasterize/conventions.py, and a test compares the two.

const float DILATION = 0.3;              // px², added to the diagonal of the 2D covariance
const float ALPHA_MAX = 0.99;            // alpha is clamped here
const float ALPHA_MIN = 1.0 / 255.0;     // a Gaussian shows exactly where its alpha is at least this
const float FRUSTUM_MARGIN = 0.3;        // of tan(fov/2): x/z, y/z in the Jacobian are clamped this far outside
const float ANTIALIAS_FLOOR = 0.005;     // least det(before dilation) / det(after) that `antialiased` uses
