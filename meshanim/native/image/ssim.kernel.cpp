// L1 and structural dissimilarity of images with their gradient, in one pass over row bands.
//
// A tile walks down its rows. Row buffers hold what the windows of 11 rows still need, so all of it stays in the
// second-level cache: s = x + y - 1 and d = x - y of the pixels, then the derivatives of SSIM by their moments.
// In s and d the formula has neither cancellation between near-equal images nor a fifth moment:
//     A1 = (ms^2 - md^2) / 2 + C1   A2 = (vs - vd) / 2 + C2        SSIM = A1 A2 / (B1 B2)
//     B1 = (ms^2 + md^2) / 2 + C1   B2 = (vs + vd) / 2 + C2
// with means ms, md and variances vs, vd of s + 1 and d under the window. Beyond the border the image is mirrored
// about its outermost pixels; the gradient of what lies there belongs to the pixels that it mirrors.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "image/ssim.h"
#include "simd.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace simd;
using image_loss::Job;
using image_loss::REACH;

constexpr int TAPS = 2 * REACH + 1, RING = 16;
constexpr float C1 = 1e-4f, C2 = 9e-4f;
// A Gaussian of sigma 1.5 at distances 0 to 5, normalised over the 11 taps.
constexpr float TAP[REACH + 1] = {2.660117249e-1f, 2.130055377e-1f, 1.093606895e-1f,
                                  3.600077213e-2f, 7.598758135e-3f, 1.028380084e-3f};

struct Window {
    Floats tap[REACH + 1];
    Window() {
        for (int k = 0; k <= REACH; ++k) tap[k] = broadcast(TAP[k]);
    }
    // The filtered value of 11 entries that lie `step` apart around `middle`.
    Floats along(const float *middle, int64_t step) const {
        Floats sum = tap[0] * load(middle);
        for (int k = 1; k <= REACH; ++k) sum = fma(tap[k], load(middle - k * step) + load(middle + k * step), sum);
        return sum;
    }
};

class Tile {
  public:
    // Columns count floats: a row of an image is width * channels of them, neighbours in x lie `channels` apart.
    Tile(const Job &job, int64_t image, int64_t row0, int64_t row1, int64_t column0, int64_t column1,
         std::vector<float> &scratch)
        : job_(job), image_(image), row0_(row0), row1_(row1), c0_(column0), c1_(column1),
          line_(job.width * job.channels), reach_(REACH * job.channels) {
        m0_ = std::max(int64_t(0), c0_ - reach_), m1_ = std::min(line_, c1_ + reach_);
        i0_ = m0_ - reach_, i1_ = m1_ + reach_;
        stride_ = (c1_ - c0_ + 4 * reach_ + 3 * LANES) / LANES * LANES;
        scratch.assign(size_t(stride_ * ROWS), 0.0f);
        float *at = scratch.data();
        auto take = [&](int64_t rows) { float *taken = at; at += rows * stride_; return taken; };
        pixels_ = take(2 * RING), moments_ = take(4), derivatives_ = take(3), smooth_ = take(3 * RING);
        map_weight_ = take(1), own_weight_ = take(1), pixel_weight_ = take(1);
        if (!job.mask) {
            std::fill(map_weight_, map_weight_ + m1_ - m0_, 1.0f);
            std::fill(own_weight_ + c0_ - m0_, own_weight_ + c1_ - m0_, 1.0f);
            std::fill(pixel_weight_, pixel_weight_ + c1_ - c0_, 1.0f);
        }
    }

    // sums: two numbers for every row of the image, weighted |d| and weighted 1 - SSIM.
    void run(double *sums) {
        const int64_t first = std::max(int64_t(0), row0_ - REACH), last = std::min(job_.height, row1_ + REACH);
        int64_t read = first - REACH, mapped = first;
        for (int64_t row = row0_; row < row1_; ++row) {
            for (; mapped < std::min(row + REACH + 1, last); ++mapped) {
                for (; read <= mapped + REACH; ++read) read_pixels(read);
                const double dissimilar = map_row(mapped);
                if (mapped >= row0_ && mapped < row1_) sums[2 * mapped + 1] = dissimilar;
            }
            sums[2 * row] = finish_row(row, first, mapped);
        }
    }

    static constexpr int64_t ROWS = 2 * RING + 4 + 3 + 3 * RING + 3;

  private:
    // Rows from -REACH on.
    float *pixels(int64_t row, int which) const { return pixels_ + (2 * ((row + RING) % RING) + which) * stride_; }
    float *smooth(int64_t row, int which) const { return smooth_ + (3 * (row % RING) + which) * stride_; }

    static int64_t mirrored(int64_t at, int64_t size) { return at < 0 ? -at : at >= size ? 2 * (size - 1) - at : at; }

    void read_pixels(int64_t row) {
        const int64_t start = (image_ * job_.height + mirrored(row, job_.height)) * line_;
        const int64_t from = std::max(i0_, int64_t(0)), count = std::min(i1_, line_) - from;
        const float *x = job_.rendered + start + from, *y = job_.target + start + from;
        float *s = pixels(row, 0) + from - i0_, *d = pixels(row, 1) + from - i0_;
        const Floats one = broadcast(1.0f);
        for (int64_t i = 0; i < count; i += LANES) {
            const int n = int(std::min<int64_t>(LANES, count - i));
            const Floats a = load_first(x + i, n), b = load_first(y + i, n);
            store(s + i, a + b - one);
            store(d + i, a - b);
        }
        for (int64_t i = i0_; i < 0; ++i) mirror(s, d, i, from);
        for (int64_t i = line_; i < i1_; ++i) mirror(s, d, i, from);
    }

    void mirror(float *s, float *d, int64_t column, int64_t from) const {
        const int64_t pixel = (column + reach_) / job_.channels - REACH, channel = column - pixel * job_.channels;
        const int64_t source = mirrored(pixel, job_.width) * job_.channels + channel;
        s[column - from] = s[source - from];
        d[column - from] = d[source - from];
    }

    void read_weights(int64_t row, float *to, int64_t from, int64_t until, int64_t origin) {
        const float *mask = job_.mask + (image_ * job_.height + row) * job_.width;
        for (int64_t i = from; i < until; ++i) to[i - origin] = mask[i / job_.channels];
    }

    // SSIM of one row of pixels: its derivatives, filtered along the row, and the weighted sum of 1 - SSIM.
    double map_row(int64_t row) {
        const Window window;
        moments_of(row, window);
        if (job_.mask) {
            read_weights(row, map_weight_, m0_, m1_, m0_);
            read_weights(row, own_weight_, c0_, c1_, m0_);
        }
        const Floats half = broadcast(0.5f), one = broadcast(1.0f), c1 = broadcast(C1), c2 = broadcast(C2);
        const Floats two = broadcast(2.0f);
        float *linear = derivatives_ + (m0_ - c0_ + reach_), *by_vs = linear + stride_, *by_vd = by_vs + stride_;
        Floats total = zeros();
        for (int64_t i = 0; i < m1_ - m0_; i += LANES) {
            const float *at = moments_ + reach_ + i;
            const Floats low = window.along(at, job_.channels), md = window.along(at + stride_, job_.channels);
            const Floats vs = window.along(at + 2 * stride_, job_.channels) - low * low;
            const Floats vd = window.along(at + 3 * stride_, job_.channels) - md * md;
            const Floats ms = low + one, ms2 = half * ms * ms, md2 = half * md * md;
            const Floats a1 = ms2 - md2 + c1, b1 = ms2 + md2 + c1;
            const Floats a2 = fma(half, vs - vd, c2), b2 = fma(half, vs + vd, c2);
            const Floats q = one / (b1 * b2), numerator = a1 * a2, ssim = numerator * q;
            total = fma(load(own_weight_ + i), one - ssim, total);
            if (!job_.gradient) continue;
            const Floats weight = load(map_weight_ + i);
            const Floats left = a2 * q, right = ssim * b2 * q;  // A2 / (B1 B2) and SSIM / B1
            const Floats up = half * a1 * q, down = half * ssim * b1 * q;
            const Floats dvs = up - down, dvd = zeros() - up - down;
            const Floats dm = ms * (left - right) - md * (left + right) - two * (low * dvs + md * dvd);
            store(linear + i, weight * dm);
            store(by_vs + i, weight * dvs);
            store(by_vd + i, weight * dvd);
        }
        if (job_.gradient)
            for (int which = 0; which < 3; ++which) {
                const float *from = derivatives_ + which * stride_ + reach_;
                float *to = smooth(row, which);
                for (int64_t i = 0; i < c1_ - c0_; i += LANES) store(to + i, window.along(from + i, job_.channels));
                add_mirrored(from, to);
            }
        return double(sum(total));
    }

    // Windows that saw a pixel's mirror image beyond the left or right border.
    void add_mirrored(const float *derivative, float *to) const {
        const int64_t channels = job_.channels, width = job_.width;
        for (int64_t distance = 1; distance <= REACH; ++distance)  // of the pixel from the border
            for (int64_t reached = 0; reached <= REACH - distance; ++reached)
                for (const bool right : {false, true}) {
                    const int64_t pixel = right ? width - 1 - distance : distance;
                    const int64_t window = right ? width - 1 - reached : reached;
                    if (pixel * channels < c0_ || pixel * channels >= c1_) continue;
                    for (int64_t c = 0; c < channels; ++c)
                        to[pixel * channels + c - c0_] +=
                            TAP[distance + reached] * derivative[window * channels + c - c0_];
                }
    }

    // Moments of s, d, s^2 and d^2 down the 11 rows around one.
    void moments_of(int64_t row, const Window &window) {
        const float *rows[2 * TAPS];
        for (int k = 0; k < TAPS; ++k)
            for (int which = 0; which < 2; ++which) rows[2 * k + which] = pixels(row + k - REACH, which);
        for (int64_t i = 0; i < i1_ - i0_; i += LANES)
            for (int which = 0; which < 2; ++which) {
                const Floats middle = load(rows[2 * REACH + which] + i);
                Floats mean = window.tap[0] * middle, square = mean * middle;
                for (int k = 1; k <= REACH; ++k) {
                    const Floats a = load(rows[2 * (REACH - k) + which] + i), b = load(rows[2 * (REACH + k) + which] + i);
                    mean = fma(window.tap[k], a + b, mean);
                    square = fma(window.tap[k], fma(a, a, b * b), square);
                }
                store(moments_ + which * stride_ + i, mean);
                store(moments_ + (2 + which) * stride_ + i, square);
            }
    }

    // How much the window around one row takes of another row, its mirror images included.
    float tap(int64_t row, int64_t window) const {
        const int64_t bottom = job_.height - 1, distance = row < window ? window - row : row - window;
        float sum = TAP[distance];
        if (row > 0 && row + window <= REACH) sum += TAP[row + window];
        if (row < bottom && 2 * bottom - row - window <= REACH) sum += TAP[2 * bottom - row - window];
        return sum;
    }

    // The gradient of one row, of which all SSIM rows within reach are mapped; returns its weighted sum of |d|.
    double finish_row(int64_t row, int64_t first, int64_t mapped) {
        if (job_.mask) read_weights(row, pixel_weight_, c0_, c1_, c0_);
        const float *s = pixels(row, 0) + (c0_ - i0_), *d = pixels(row, 1) + (c0_ - i0_);
        const int64_t from = std::max(first, row - REACH), count = std::min(mapped, row + REACH + 1) - from;
        Floats taps[TAPS];
        for (int64_t k = 0; k < count; ++k) taps[k] = broadcast(tap(row, from + k));
        float *out = job_.gradient ? job_.gradient + (image_ * job_.height + row) * line_ + c0_ : nullptr;
        const Floats l1 = broadcast(job_.l1_scale), similar = broadcast(-job_.ssim_scale), two = broadcast(2.0f);
        const Floats one = broadcast(1.0f), huge = broadcast(1e38f);
        Floats total = zeros();
        for (int64_t i = 0; i < c1_ - c0_; i += LANES) {
            const Floats difference = load(d + i), weight = load(pixel_weight_ + i);
            total = fma(weight, maximum(difference, zeros() - difference), total);
            if (!out) continue;
            Floats parts[3] = {zeros(), zeros(), zeros()};
            for (int64_t k = 0; k < count; ++k) {
                const float *at = smooth(from + k, 0) + i;
                for (int which = 0; which < 3; ++which)
                    parts[which] = fma(taps[k], load(at + which * stride_), parts[which]);
            }
            const Floats sign = minimum(maximum(difference * huge, zeros() - one), one);
            const Floats by_ssim = parts[0] + two * (load(s + i) * parts[1] + difference * parts[2]);
            const Floats slope = fma(similar, by_ssim, l1 * weight * sign);
            const int n = int(std::min<int64_t>(LANES, c1_ - c0_ - i));
            n == LANES ? store(out + i, slope) : store_first(out + i, slope, n);
        }
        return double(sum(total));
    }

    const Job &job_;
    int64_t image_, row0_, row1_, c0_, c1_, line_, reach_, m0_, m1_, i0_, i1_, stride_;
    float *pixels_, *moments_, *derivatives_, *smooth_, *map_weight_, *own_weight_, *pixel_weight_;
};

}  // namespace

// sums: (images, column tiles, rows, 2); every number is written by one tile, whatever the number of threads.
void image_loss_tiles(const Job &job, int64_t tile_width, double *sums, int threads) {
    const int64_t columns = (job.width + tile_width - 1) / tile_width, strips = job.images * columns;
    const int64_t bands = std::min(job.height, (threads + strips - 1) / strips);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int64_t task = 0; task < strips * bands; ++task) {
        static thread_local std::vector<float> scratch;
        const int64_t strip = task / bands, band = task % bands, column = strip % columns;
        const int64_t from = column * tile_width, until = std::min(job.width, from + tile_width);
        Tile tile(job, strip / columns, job.height * band / bands, job.height * (band + 1) / bands,
                  from * job.channels, until * job.channels, scratch);
        tile.run(sums + strip * job.height * 2);
    }
}

}  // namespace MESHANIM_NAMESPACE
