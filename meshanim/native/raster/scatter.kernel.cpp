// Subsurface scattering as two Gaussians a colour over the irradiance on screen, weighted by coverage and depth
// (Jimenez et al. 2009, Screen-Space Perceptual Rendering of Human Skin), then the tone curve.
#include <algorithm>
#include <cmath>
#include <vector>

#include "raster.h"
#include "vector.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace raster;

constexpr float DEPTH_REACH = 0.006f;        // metres: light does not cross larger steps

struct Tap {
    float weight;
};

// One direction of the blur; `step` is 1 or the row length. Inputs and outputs: irradiance and coverage.
void pass(const float *light, const float *cover, const float *near, float *light_out, float *cover_out, const Tap *taps,
          int radius, int64_t step, int lo, int hi) {
    constexpr float INVERSE = 1 / DEPTH_REACH;
    for (int x = lo; x < hi; ++x) light_out[x] = cover_out[x] = 0;
    for (int k = -radius; k <= radius; ++k) {
        const float w = taps[std::abs(k)].weight;
        const int64_t shift = k * step;
#pragma omp simd
        for (int x = lo; x < hi; ++x) {
            const float d = (near[x + shift] - near[x]) * INVERSE;
            const float g = w * std::max(0.0f, 1 - d * d);
            light_out[x] += g * light[x + shift];
            cover_out[x] += g * cover[x + shift];
        }
    }
}

}  // namespace

// sigma (2, 3) in pixels: wide and narrow; share of the wide one. scratch: (6, height, width).
// Adds albedo times the blurred irradiance to the LIGHT planes.
void scatter(float *planes, const float *near, int width, int height, const float *sigma, float wide_share, float *scratch,
             int threads) {
    const int64_t area = int64_t(width) * height;
    const float *cover = planes + SCATTER * area;
    int top = height, bottom = 0, left = width, right = 0;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            if (cover[y * int64_t(width) + x] > 0) top = std::min(top, y), bottom = std::max(bottom, y + 1), left = std::min(left, x), right = std::max(right, x + 1);
    if (top >= bottom) return;
    for (int channel = 0; channel < 3; ++channel) {
        const float *light = planes + (IRRADIANCE + channel) * area, *albedo = planes + (ALBEDO + channel) * area;
        float *out = planes + (LIGHT + channel) * area;
        for (int lobe = 0; lobe < 2; ++lobe) {
            const float s = sigma[3 * lobe + channel], share = lobe == 0 ? wide_share : 1 - wide_share;
            const int radius = s > 0.35f ? std::max(1, int(2.5f * s + 0.5f)) : 0;
            std::vector<Tap> taps(radius + 1);
            for (int k = 0; k <= radius; ++k) taps[k].weight = radius ? std::exp(-0.5f * k * k / (s * s)) : 1.0f;
            float *row_light = scratch, *row_cover = scratch + area, *blurred = scratch + 2 * area, *blurred_cover = scratch + 3 * area;
            const int reach = radius, first = std::max(0, top - reach), last = std::min(height, bottom + reach);
#pragma omp parallel num_threads(threads)
            {
#pragma omp for schedule(static)
                for (int y = first; y < last; ++y) {
                    const int64_t at = int64_t(y) * width;
                    // Columns whose taps stay inside the picture, then the two borders with fewer taps.
                    for (int lo = left; lo < right;) {
                        const int room = std::min(reach, std::min(lo, width - 1 - lo));
                        int hi = lo + 1;
                        if (room == reach) hi = std::max(lo + 1, std::min(right, width - reach));
                        pass(light + at, cover + at, near + at, row_light + at, row_cover + at, taps.data(), room, 1, lo, hi);
                        lo = hi;
                    }
                }
#pragma omp for schedule(static)
                for (int y = top; y < bottom; ++y) {
                    const int64_t at = int64_t(y) * width;
                    const int room = std::min(reach, std::min(y - first, last - 1 - y));
                    pass(row_light + at, row_cover + at, near + at, blurred + at, blurred_cover + at, taps.data(), room, width, left, right);
                    for (int x = left; x < right; ++x)
                        if (blurred_cover[at + x] > 0)
                            out[at + x] += share * albedo[at + x] * blurred[at + x] / blurred_cover[at + x];
                }
            }
        }
    }
}

// Composite over the background (height, width, 3; linear) and apply the tone curve x (1 + x / 9) / (1 + 0.62 x) 1.22
// and gamma 2.2; image (height, width, 3) in [0, 255].
void develop(const float *planes, const float *background, int width, int height, uint8_t *image, int threads) {
    const int64_t area = int64_t(width) * height;
    constexpr int SIZE = 4096;
    struct Level {
        uint8_t value;
    };
    static const std::vector<Level> table = [] {
        std::vector<Level> t(SIZE + 1);
        for (int i = 0; i <= SIZE; ++i) t[i].value = uint8_t(255 * std::pow(i / float(SIZE), 1 / 2.2f) + 0.5f);
        return t;
    }();
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < area; ++i) {
        const float rest = 1 - std::min(planes[OPACITY * area + i], 1.0f);
        for (int k = 0; k < 3; ++k) {
            float x = clamp(planes[(LIGHT + k) * area + i] + rest * background[3 * i + k], 0.0f, 16.0f);
            x = std::min(x * (1 + x / 9) / (1 + 0.62f * x) * 1.22f, 1.0f);
            image[3 * i + k] = table[int(x * SIZE + 0.5f)].value;
        }
    }
}

}  // namespace MESHANIM_NAMESPACE
