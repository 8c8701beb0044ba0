// Constants that all engines share, equal to those of progdf/rasterize/engines.py. A test compares the two.

const float DILATION = 0.3;              // px², added to the diagonal of the 2D covariance
const float ALPHA_MAX = 0.99;            // upper limit of alpha
const float ALPHA_MIN = 1.0 / 255.0;     // a Gaussian is visible exactly where its alpha is at least this
const float FRUSTUM_MARGIN = 0.3;        // of tan(fov/2): margin of x/z and y/z in the Jacobian beyond the frustum
const float ANTIALIAS_FLOOR = 0.005;     // minimum of det(before dilation) / det(after) for `antialiased`
