// Binding of the blendshape solve (motion/box_programs.py and motion/blendshape_solver.py call it).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "../isa.h"
#include "boxqp.h"

namespace nb = nanobind;
using namespace nb::literals;

MESHANIM_DECLARE(void project(const Projection &))
MESHANIM_DECLARE(void box_programs(const BoxPrograms &))

namespace {

template <class T, int Dimensions>
using Array = nb::ndarray<T, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

void require(bool condition, const char *what) {
    if (!condition) throw std::invalid_argument(what);
}

void project_frames(Array<const float, 2> tiles, Array<const int32_t, 1> column, Array<const int32_t, 1> place,
                    Array<const int32_t, 1> offsets, Array<const float, 3> frames, Array<const int32_t, 1> sampled,
                    Array<const float, 2> neutral, Array<double, 2> out, int threads) {
    Projection p{};
    p.matrix = {tiles.data(), column.data(), place.data(), offsets.data(), int64_t(offsets.size()) - 1,
                int64_t(out.shape(1))};
    p.frames = frames.data();
    p.sampled = sampled.data();
    p.neutral = neutral.data();
    p.out = out.data();
    p.count = int64_t(frames.shape(0));
    p.vertices = int64_t(frames.shape(1));
    p.samples = int64_t(sampled.size());
    p.threads = threads;
    const size_t count = tiles.shape(0);
    require(tiles.shape(1) == size_t(TiledMatrix::TILE) || count == 0, "tiles must have 64 columns");
    require(column.size() == count && place.size() == count && offsets.size() >= 1, "tiles do not fit together");
    require(frames.shape(2) == 3 && neutral.shape(0) == sampled.size() && neutral.shape(1) == 3,
            "frames must be (count, vertices, 3), neutral a row a sampled vertex");
    require(p.matrix.strips * TiledMatrix::STRIP >= 3 * p.samples, "too few strips for the sampled vertices");
    require(out.shape(0) == frames.shape(0) && threads > 0, "out needs a row a frame, threads must be positive");
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(project, p);
}

void solve_programs(Array<const double, 2> gram, Array<const double, 2> linear, Array<const int32_t, 2> pairs,
                    Array<const double, 2> feedback, Array<const double, 2> extra, Array<const double, 1> strength,
                    Array<double, 1> previous, Array<int8_t, 1> bound, Array<double, 2> out, int threads) {
    BoxPrograms p{};
    const size_t n = gram.shape(0), count = linear.shape(0);
    const auto square = [n](const Array<const double, 2> &matrix) {
        return matrix.size() == 0 || (matrix.shape(0) == n && matrix.shape(1) == n);
    };
    require(n > 0 && gram.shape(1) == n && square(feedback) && square(extra), "matrices must be (n, n)");
    require(linear.shape(1) == n && out.shape(0) == count && out.shape(1) == n, "linear and out must be (count, n)");
    require(previous.size() == n && bound.size() == n, "previous and bound must be (n)");
    require(extra.size() == 0 || strength.size() == count, "strength must be (count)");
    require((pairs.size() == 0 || pairs.shape(1) == 2) && threads > 0, "pairs must be (k, 2), threads positive");
    for (size_t i = 0; i < pairs.size(); ++i)
        require(pairs.data()[i] >= 0 && size_t(pairs.data()[i]) < n, "a pair names a weight that does not exist");
    p.gram = gram.data();
    p.linear = linear.data();
    p.pairs = pairs.data();
    p.feedback = feedback.size() ? feedback.data() : nullptr;
    p.extra = extra.size() ? extra.data() : nullptr;
    p.strength = strength.data();
    p.previous = previous.data();
    p.bound = bound.data();
    p.out = out.data();
    p.count = int64_t(count);
    p.n = int64_t(n);
    p.n_pairs = int64_t(pairs.size() / 2);
    p.threads = threads;
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(box_programs, p);
}

}  // namespace

void bind_boxqp(nb::module_ &m) {
    m.def("project_frames", &project_frames, "tiles"_a.noconvert(), "column"_a.noconvert(), "place"_a.noconvert(),
          "offsets"_a.noconvert(), "frames"_a.noconvert(), "sampled"_a.noconvert(), "neutral"_a.noconvert(),
          "out"_a.noconvert(), "threads"_a, "Products of a tiled matrix with the displacements of frames.");
    m.def("solve_programs", &solve_programs, "gram"_a.noconvert(), "linear"_a.noconvert(), "pairs"_a.noconvert(),
          "feedback"_a.noconvert(), "extra"_a.noconvert(), "strength"_a.noconvert(), "previous"_a.noconvert(),
          "bound"_a.noconvert(), "out"_a.noconvert(), "threads"_a,
          "Quadratic programs over the box [0, 1], one a row of linear.");
}
