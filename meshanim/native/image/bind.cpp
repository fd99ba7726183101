// meshanim._native.image_loss (gaussians/losses.py calls it).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "image/ssim.h"
#include "isa.h"

namespace nb = nanobind;
using namespace nb::literals;
using image_loss::Job;

MESHANIM_DECLARE(void image_loss_tiles(const Job &, int64_t, double *, int))

namespace {

template <class T, int Rank> using Array = nb::ndarray<T, nb::ndim<Rank>, nb::c_contig, nb::device::cpu>;
using Images = Array<const float, 4>;

// Pixels that a tile is wide: its row buffers take about 280 KB with three channels.
constexpr int64_t TILE = 256;

bool same(const Images &a, const Images &b) {
    for (int axis = 0; axis < 4; ++axis)
        if (a.shape(axis) != b.shape(axis)) return false;
    return true;
}

std::pair<double, double> loss(Images rendered, Images target, std::optional<Array<const float, 3>> mask,
                               std::optional<Array<float, 4>> gradient, float l1_scale, float ssim_scale, int threads) {
    const int64_t images = rendered.shape(0), height = rendered.shape(1), width = rendered.shape(2);
    const int64_t least = 2 * image_loss::REACH + 1;
    if (!same(rendered, target) || (gradient && !same(rendered, Images(*gradient))))
        throw std::invalid_argument("rendered, target and gradient must have one shape");
    if (height < least || width < least) throw std::invalid_argument("images must be at least 11 x 11");
    if (mask && (int64_t(mask->shape(0)) != images || int64_t(mask->shape(1)) != height || int64_t(mask->shape(2)) != width))
        throw std::invalid_argument("mask needs one value a pixel");
    if (threads < 1) throw std::invalid_argument("threads must be at least 1");
    const Job job{rendered.data(), target.data(), mask ? mask->data() : nullptr, gradient ? gradient->data() : nullptr,
                  images, height, width, int64_t(rendered.shape(3)), l1_scale, ssim_scale};
    std::vector<double> sums(size_t(images * ((width + TILE - 1) / TILE) * height * 2), 0.0);
    MESHANIM_DISPATCH(image_loss_tiles, job, TILE, sums.data(), threads);
    double absolute = 0, dissimilar = 0;
    for (size_t row = 0; row < sums.size(); row += 2) absolute += sums[row], dissimilar += sums[row + 1];
    return {absolute, dissimilar};
}

}  // namespace

void bind_image(nb::module_ &m) {
    m.def("image_loss", &loss, nb::call_guard<nb::gil_scoped_release>(), "rendered"_a, "target"_a, "mask"_a.none(),
          "gradient"_a.none(), "l1_scale"_a, "ssim_scale"_a, "threads"_a,
          "Sums over the pixels of weight |rendered - target| and weight (1 - SSIM); writes the gradient of "
          "l1_scale times the one plus ssim_scale times the other.");
}
