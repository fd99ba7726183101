// meshanim._native.color_network and color_network_backward (gaussians/avatar/colors_native.py calls them).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <initializer_list>
#include <optional>
#include <stdexcept>

#include "colors/colors.h"
#include "isa.h"
#include "memory/pool.h"

namespace nb = nanobind;
using namespace nb::literals;

MESHANIM_DECLARE(void color_network(const ColorNetwork &, float *, float *))
MESHANIM_DECLARE(void color_network_backward(const ColorNetwork &, const ColorGradients &, float *))

namespace {

template <int RANK> using Array = nb::ndarray<float, nb::ndim<RANK>, nb::c_contig, nb::device::cpu>;
template <int RANK> using Given = nb::ndarray<const float, nb::ndim<RANK>, nb::c_contig, nb::device::cpu>;

template <class Tensor> void require(const Tensor &tensor, std::initializer_list<int64_t> shape) {
    size_t axis = 0;
    for (const int64_t size : shape)
        if (int64_t(tensor.shape(axis++)) != size)
            throw std::invalid_argument("color network: tensors do not fit together");
}

ColorNetwork network_of(const Given<2> &latents, const Given<2> &frame, const Given<2> &by_latent,
                        const Given<2> &inner, const Given<1> &inner_bias, const Given<2> &outer,
                        const std::optional<Given<2>> &constant, const Given<2> &others, float scale, int threads) {
    const int64_t rows = latents.shape(0), latent = latents.shape(1), hidden = frame.shape(1);
    require(by_latent, {latent, hidden});
    require(inner, {hidden, hidden});
    require(inner_bias, {hidden});
    require(outer, {hidden, 3});
    if (constant) require(*constant, {rows, 3});
    require(others, {rows, int64_t(others.shape(1))});
    if (threads < 1) throw std::invalid_argument("color network: threads must be at least 1");
    return {{int64_t(frame.shape(0)), rows, latent, hidden, int64_t(others.shape(1)), threads},
            latents.data(),
            frame.data(),
            by_latent.data(),
            inner.data(),
            inner_bias.data(),
            outer.data(),
            constant ? constant->data() : nullptr,
            others.data(),
            scale};
}

memory::Lease workspace(const ColorSizes &sizes, bool backward) {
    return memory::Lease(sizeof(float) * size_t(color_workspace(sizes, backward)));
}

void forward(Given<2> latents, Given<2> frame, Given<2> by_latent, Given<2> inner, Given<1> inner_bias, Given<2> outer,
             std::optional<Given<2>> constant, Given<2> others, float scale, int threads, Array<3> out) {
    const ColorNetwork n =
        network_of(latents, frame, by_latent, inner, inner_bias, outer, constant, others, scale, threads);
    require(out, {n.sizes.frames, n.sizes.rows, 3 + n.sizes.rest});
    const memory::Lease lease = workspace(n.sizes, false);
    MESHANIM_DISPATCH(color_network, n, out.data(), static_cast<float *>(lease.data()));
}

void backward(Given<2> latents, Given<2> frame, Given<2> by_latent, Given<2> inner, Given<1> inner_bias,
              Given<2> outer, std::optional<Given<2>> constant, Given<2> others, float scale, Given<3> grad_out,
              int threads, Array<2> grad_latents, Array<2> grad_frame, Array<2> grad_by_latent, Array<2> grad_inner,
              Array<1> grad_inner_bias, Array<2> grad_outer, std::optional<Array<2>> grad_constant,
              std::optional<Array<2>> grad_others) {
    const ColorNetwork n =
        network_of(latents, frame, by_latent, inner, inner_bias, outer, constant, others, scale, threads);
    const ColorSizes &s = n.sizes;
    require(grad_out, {s.frames, s.rows, 3 + s.rest});
    require(grad_latents, {s.rows, s.latent});
    require(grad_frame, {s.frames, s.hidden});
    require(grad_by_latent, {s.latent, s.hidden});
    require(grad_inner, {s.hidden, s.hidden});
    require(grad_inner_bias, {s.hidden});
    require(grad_outer, {s.hidden, 3});
    if (grad_constant) require(*grad_constant, {s.rows, 3});
    if (grad_others) require(*grad_others, {s.rows, s.rest});
    const ColorGradients g{grad_out.data(),
                           grad_latents.data(),
                           grad_frame.data(),
                           grad_by_latent.data(),
                           grad_inner.data(),
                           grad_inner_bias.data(),
                           grad_outer.data(),
                           grad_constant ? grad_constant->data() : nullptr,
                           grad_others ? grad_others->data() : nullptr};
    const memory::Lease lease = workspace(s, true);
    MESHANIM_DISPATCH(color_network_backward, n, g, static_cast<float *>(lease.data()));
}

}  // namespace

void bind_colors(nb::module_ &m) {
    m.def("color_network", &forward, nb::call_guard<nb::gil_scoped_release>(), "latents"_a, "frame"_a, "by_latent"_a,
          "inner"_a, "inner_bias"_a, "outer"_a, "constant"_a.none(), "others"_a, "scale"_a, "threads"_a, "out"_a,
          "constant + scale relu(relu(frame + latents by_latent) inner + inner_bias) outer beside others, a frame at a "
          "time, written to out.");
    m.def("color_network_backward", &backward, nb::call_guard<nb::gil_scoped_release>(), "latents"_a, "frame"_a,
          "by_latent"_a, "inner"_a, "inner_bias"_a, "outer"_a, "constant"_a.none(), "others"_a, "scale"_a,
          "grad_out"_a, "threads"_a, "grad_latents"_a, "grad_frame"_a, "grad_by_latent"_a, "grad_inner"_a,
          "grad_inner_bias"_a, "grad_outer"_a, "grad_constant"_a.none(), "grad_others"_a.none(),
          "Gradients of color_network, written to the last eight.");
}
