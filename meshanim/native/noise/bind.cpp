// meshanim._native.value_noise (render/look/noise.py calls it).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "isa.h"

namespace nb = nanobind;
using namespace nb::literals;

MESHANIM_DECLARE(void value_noise(const float *, int64_t, const float *, int, const float *, const float *,
                                  const float *, int, float *, int))

namespace {

template <class T, class Shape> using Array = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
using Rows = Array<const float, nb::shape<-1, 3>>;

void value_noise(Rows points, Array<const float, nb::shape<-1, -1, -1>> volume, Rows scale, Rows shift,
                 Array<const float, nb::shape<-1>> weight, Array<float, nb::shape<-1>> out, int threads) {
    const size_t size = volume.shape(0), octaves = weight.shape(0);
    if (volume.shape(1) != size || volume.shape(2) != size || size == 0 || (size & (size - 1)))
        throw std::invalid_argument("volume must be a cube whose side is a power of two");
    if (scale.shape(0) != octaves || shift.shape(0) != octaves || out.shape(0) != points.shape(0))
        throw std::invalid_argument("scale, shift and weight need a row an octave, out one a point");
    if (threads < 1) throw std::invalid_argument("threads must be at least 1");
    MESHANIM_DISPATCH(value_noise, points.data(), int64_t(points.shape(0)), volume.data(), int(size), scale.data(),
                      shift.data(), weight.data(), int(octaves), out.data(), threads);
}

}  // namespace

void bind_noise(nb::module_ &m) {
    m.def("value_noise", &value_noise, nb::call_guard<nb::gil_scoped_release>(), "points"_a, "volume"_a, "scale"_a,
          "shift"_a, "weight"_a, "out"_a, "threads"_a,
          "Sum of weighted octaves of trilinear noise in a periodic cube, written to out.");
}
