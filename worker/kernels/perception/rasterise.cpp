// A depth camera in software.
#include "../lanes.hpp"

// Draws triangles into an image [height, width] of depths [m]: pixels [n, 2] and depth [n] [m] of their corners,
// faces [f, 3]. Nearer surfaces hide others; those behind the camera are left out.
KERNEL void rasterise(double* image, const double* pixels, const double* depth, const int64_t* faces,
                      int64_t height, int64_t width, int64_t /*corners*/, int64_t face_count) {
  for (int64_t face = 0; face < face_count; ++face) {
    const int64_t a = faces[3 * face], b = faces[3 * face + 1], c = faces[3 * face + 2];
    if (depth[a] <= 1e-6 || depth[b] <= 1e-6 || depth[c] <= 1e-6) continue;
    const double ax = pixels[2 * a], ay = pixels[2 * a + 1], bx = pixels[2 * b], by = pixels[2 * b + 1];
    const double cx = pixels[2 * c], cy = pixels[2 * c + 1];
    const double area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if (fabs(area) < 1e-12) continue;
    auto first = [](double x, double y, double z) {
      return greater(static_cast<int64_t>(ceil(lesser(lesser(x, y), z))), int64_t{0});
    };
    auto last = [](double x, double y, double z, int64_t most) {
      return lesser(static_cast<int64_t>(greater(greater(x, y), z)), most);
    };
    for (int64_t row = first(ay, by, cy), low = last(ay, by, cy, height - 1); row <= low; ++row)
      for (int64_t column = first(ax, bx, cx), right = last(ax, bx, cx, width - 1); column <= right; ++column) {
        const double u = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / area;
        const double v = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / area, w = 1.0 - u - v;
        if (u < 0.0 || v < 0.0 || w < 0.0) continue;
        // Straight lines in space stay straight in 1/z, not in z.
        const double z = 1.0 / (u / depth[a] + v / depth[b] + w / depth[c]);
        double& seen = image[width * row + column];
        if (z < seen) seen = z;
      }
  }
}
