// Trilinear value noise in a periodic volume: the sum of octaves, a point at a time.
#include <cmath>
#include <cstdint>

#include "isa.h"

namespace MESHANIM_NAMESPACE {

// The volume has size^3 entries, size a power of two; axis 0 is x. Octave o looks up point * scale[o] + shift[o].
void value_noise(const float *points, int64_t count, const float *volume, int size, const float *scale,
                 const float *shift, const float *weight, int octaves, float *out, int threads) {
    const int mask = size - 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < count; ++i) {
        float total = 0;
        for (int o = 0; o < octaves; ++o) {
            float fraction[3];
            int low[3], high[3];
            for (int axis = 0; axis < 3; ++axis) {
                const float at = points[3 * i + axis] * scale[3 * o + axis] + shift[3 * o + axis];
                const float whole = std::floor(at);
                fraction[axis] = at - whole;
                low[axis] = int(whole) & mask;
                high[axis] = (low[axis] + 1) & mask;
            }
            float plane[2];
            for (int x = 0; x < 2; ++x) {
                const float *sheet = volume + int64_t(x ? high[0] : low[0]) * size * size;
                const float *near = sheet + int64_t(low[1]) * size, *far = sheet + int64_t(high[1]) * size;
                const float a = near[low[2]] + fraction[2] * (near[high[2]] - near[low[2]]);
                const float b = far[low[2]] + fraction[2] * (far[high[2]] - far[low[2]]);
                plane[x] = a + fraction[1] * (b - a);
            }
            total += weight[o] * (plane[0] + fraction[0] * (plane[1] - plane[0]));
        }
        out[i] = total;
    }
}

}  // namespace MESHANIM_NAMESPACE
