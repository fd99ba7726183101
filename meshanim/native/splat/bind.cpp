// meshanim._native.splat_forward and splat_backward (gaussians/splat/native.py calls them): memory and order of the
// stages. What backward needs again lives in a `State`, held by a tensor of one float so that autograd frees it when
// it frees the graph; its memory and all scratch come from the pool.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include "isa.h"
#include "memory/pool.h"
#include "splat.h"

namespace nb = nanobind;
using namespace nb::literals;

MESHANIM_DECLARE(void splat_project(const splat::Scene &, const team::Member &, const splat::Projected &))
MESHANIM_DECLARE(void splat_collect(const splat::Scene &, const team::Member &, const splat::Projected &, splat::Key *, int32_t *))
MESHANIM_DECLARE(splat::Key *splat_sort(const splat::Scene &, const team::Member &, const splat::Order &))
MESHANIM_DECLARE(void splat_fill(const splat::Scene &, const team::Member &, const splat::Order &, const splat::Key *,
                                 const splat::Rectangle *, const splat::Bins &))
MESHANIM_DECLARE(void splat_blend(const splat::Scene &, const team::Member &, const splat::Forward &))
MESHANIM_DECLARE(int64_t splat_scratch(int64_t entries))
MESHANIM_DECLARE(void splat_blend_backward(const splat::Scene &, const team::Member &, const splat::Backward &))
MESHANIM_DECLARE(void splat_project_backward(const splat::Scene &, const team::Member &, const splat::ParameterGradients &))
MESHANIM_DECLARE(double fused_multiply_adds(int64_t rounds, int threads, float *out))

namespace {

using splat::Scene;

template <class T, class Shape> using Contiguous = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
template <int WIDTH> using Rows = Contiguous<const float, nb::shape<-1, -1, WIDTH>>;
using Values = Contiguous<const float, nb::shape<-1, -1>>;
using Poses = Contiguous<const float, nb::shape<-1, 4, 4>>;
using Intrinsics = Contiguous<const float, nb::shape<-1, 3, 3>>;
using Output = nb::ndarray<nb::pytorch, float, nb::device::cpu>;
using Token = Contiguous<const float, nb::shape<1>>;
using Target = std::optional<Contiguous<float, nb::c_contig>>;
template <int DIMENSIONS> using Gradient = std::optional<nb::ndarray<const float, nb::ndim<DIMENSIONS>, nb::device::cpu>>;

void require(bool condition, const char *what) {
    if (!condition) throw std::invalid_argument(what);
}

// Consecutive arrays in one block of the pool.
class Arena {
   public:
    template <class T> void reserve(T *&pointer, int64_t count) {
        wanted_.push_back({reinterpret_cast<void **>(&pointer), bytes_});
        bytes_ += (sizeof(T) * size_t(count) + 63) / 64 * 64;
    }
    void allocate() {
        lease_ = std::make_unique<memory::Lease>(bytes_);
        for (const auto &[pointer, offset] : wanted_) *pointer = static_cast<char *>(lease_->data()) + offset;
        wanted_.clear();
    }

   private:
    std::vector<std::pair<void **, size_t>> wanted_;
    size_t bytes_ = 0;
    std::unique_ptr<memory::Lease> lease_;
};

struct SceneArrays {
    Rows<3> means;
    Rows<4> quaternions;
    Rows<3> scales;
    Values opacities;
    Contiguous<const float, nb::shape<-1, -1, -1>> colors;
    Poses poses;
    Intrinsics intrinsics;
    Values background;
};

template <class Array> splat::Field field(const Array &array, const Scene &scene, int64_t width) {
    require(int64_t(array.shape(1)) == scene.gaussians, "splat: a field has another number of Gaussians");
    require(array.shape(0) == 1 || int64_t(array.shape(0)) == scene.frames, "splat: a field has another batch");
    return {array.data(), array.shape(0) == 1 ? 0 : width * scene.gaussians};
}

struct SceneHandle {
    Scene scene;
    SceneArrays arrays;

    SceneHandle(Rows<3> means, Rows<4> quaternions, Rows<3> scales, Values opacities,
                Contiguous<const float, nb::shape<-1, -1, -1>> colors, int coefficients, Poses poses, Intrinsics intrinsics,
                Values background, int64_t cameras, int width, int height, float near, float far, float eps2d,
                float max_alpha, bool antialiased, bool depth, int threads)
        : arrays{means, quaternions, scales, opacities, colors, poses, intrinsics, background} {
        require(cameras > 0 && poses.shape(0) % size_t(cameras) == 0 && poses.shape(0) == intrinsics.shape(0) &&
                    poses.shape(0) == background.shape(0),
                "splat: cameras and background do not fit together");
        require(width > 0 && height > 0 && threads > 0, "splat: sizes and threads must be positive");
        require(coefficients == 0 || int64_t(colors.shape(2)) == 3 * coefficients, "splat: harmonics have the wrong shape");
        scene.frames = int64_t(poses.shape(0)) / cameras, scene.cameras = cameras, scene.gaussians = int64_t(means.shape(1));
        scene.width = width, scene.height = height;
        scene.channels = coefficients ? 3 : int64_t(colors.shape(2)), scene.coefficients = coefficients;
        require(int64_t(background.shape(1)) == scene.channels, "splat: the background has another number of channels");
        scene.means = field(means, scene, 3), scene.quaternions = field(quaternions, scene, 4), scene.scales = field(scales, scene, 3);
        scene.opacities = field(opacities, scene, 1), scene.colors = field(colors, scene, int64_t(colors.shape(2)));
        scene.poses = poses.data(), scene.intrinsics = intrinsics.data(), scene.background = background.data();
        scene.near = near, scene.far = far, scene.eps2d = eps2d, scene.max_alpha = max_alpha;
        scene.safe_level = std::log2(max_alpha) - 1e-5f;
        scene.antialiased = antialiased, scene.depth = depth, scene.threads = threads;
        require(scene.items() < int64_t(std::numeric_limits<int32_t>::max()) && scene.columns() < 65536 && scene.rows() < 65536,
                "splat: too many Gaussians times images, or too large an image; render fewer images at once");
    }
};

struct State {
    static constexpr uint32_t MAGIC = 0x53504c54;
    float token = 0;   // first: what the tensor shows
    uint32_t magic = MAGIC;
    int64_t items = 0, tiles = 0, entries = 0;
    float *records = nullptr;
    splat::Bins bins{};
    uint16_t *masks = nullptr;
    int32_t *used = nullptr;
    Arena of_items, of_entries;
    SceneHandle handle;

    explicit State(const SceneHandle &scene) : handle(scene) {}
};

const State &state_of(const Token &token) {
    const State &state = *reinterpret_cast<const State *>(token.data());
    require(state.magic == State::MAGIC, "splat: this is not a state");
    return state;
}

// Exclusive prefix sum in place; returns the total.
int64_t accumulate(int64_t *counts, int64_t size) {
    int64_t total = 0;
    for (int64_t i = 0; i < size; ++i) {
        const int64_t count = counts[i];
        counts[i] = total;
        total += count;
    }
    return total;
}

// False if a value is not finite.
bool render(const Scene &scene, State &state, float *planes, int32_t *radii) {
    state.items = scene.items(), state.tiles = scene.tiles();
    const int64_t tasks = scene.images() * scene.chunks();
    splat::Projected projected{};
    splat::Order order{};
    Arena scratch;
    state.of_items.reserve(state.records, state.items * splat::RECORD);
    state.of_items.reserve(state.bins.slots, state.items + 1);
    state.of_items.reserve(state.bins.tiles, state.tiles + 1);
    state.of_items.reserve(state.used, state.tiles);
    state.of_items.allocate();
    scratch.reserve(projected.depths, state.items);
    scratch.reserve(projected.rectangles, state.items);
    scratch.reserve(projected.chunk_items, tasks);
    scratch.reserve(projected.chunk_entries, tasks);
    scratch.reserve(projected.chunk_bad, tasks);
    scratch.reserve(projected.chunk_least, tasks);
    scratch.reserve(projected.chunk_most, tasks);
    scratch.reserve(order.keys, state.items);
    scratch.reserve(order.other, state.items);
    scratch.reserve(order.counts, int64_t(scene.threads) * std::max<int64_t>(state.tiles, 1 << splat::DIGIT));
    scratch.allocate();
    projected.records = state.records, projected.radii = radii;

    bool finite = true;
    auto prepare = [&] {
        for (int64_t task = 0; task < tasks; ++task) finite = finite && !projected.chunk_bad[task];
        if (!finite) return;
        order.count = accumulate(projected.chunk_items, tasks);
        order.least = tasks ? *std::min_element(projected.chunk_least, projected.chunk_least + tasks) : 0;
        order.most = tasks ? *std::max_element(projected.chunk_most, projected.chunk_most + tasks) : 0;
        state.entries = accumulate(projected.chunk_entries, tasks);
        require(state.entries < int64_t(std::numeric_limits<int32_t>::max()), "splat: the Gaussians cover too many tiles; render fewer images at once");
        state.bins.count = state.entries;
        state.of_entries.reserve(state.bins.entries, state.entries);
        state.of_entries.reserve(state.masks, state.entries + 16);
        state.of_entries.allocate();
        state.bins.slots[state.items] = int32_t(state.entries);
    };
    team::run(scene.threads, [&](const team::Member &member) {
        MESHANIM_DISPATCH(splat_project, scene, member, projected);
        team::alone(member, prepare);
        if (!finite) return;
        MESHANIM_DISPATCH(splat_collect, scene, member, projected, order.keys, state.bins.slots);
        team::wait(member);
        const splat::Key *sorted = MESHANIM_DISPATCH(splat_sort, scene, member, order);
        MESHANIM_DISPATCH(splat_fill, scene, member, order, sorted, projected.rectangles, state.bins);
        team::wait(member);
        const splat::Forward out{state.records, state.bins, state.masks, state.used, planes};
        MESHANIM_DISPATCH(splat_blend, scene, member, out);
    });
    return finite;
}

template <class T> nb::capsule owner_of(T *pointer) {
    return nb::capsule(pointer, [](void *p) noexcept { delete static_cast<T *>(p); });
}

nb::tuple forward(const SceneHandle &handle) {
    const Scene &scene = handle.scene;
    const int64_t planes_size = scene.images() * (scene.blended() + 1) * scene.height * scene.width;
    auto planes = std::make_unique<memory::Lease>(sizeof(float) * size_t(planes_size));
    auto radii = std::make_unique<memory::Lease>(sizeof(int32_t) * size_t(scene.items() * 2));
    auto state = std::make_unique<State>(handle);
    bool finite;
    {
        nb::gil_scoped_release release;
        finite = render(scene, *state, static_cast<float *>(planes->data()), static_cast<int32_t *>(radii->data()));
    }
    const size_t shape[] = {size_t(scene.images()), size_t(scene.blended() + 1), size_t(scene.height), size_t(scene.width)};
    const size_t radii_shape[] = {size_t(scene.images()), size_t(scene.gaussians), 2}, one[] = {1};
    void *const planes_data = planes->data(), *const radii_data = radii->data();
    State *const held = state.release();
    return nb::make_tuple(finite, Output(planes_data, 4, shape, owner_of(planes.release())),
                          nb::ndarray<nb::pytorch, int32_t, nb::device::cpu>(radii_data, 3, radii_shape, owner_of(radii.release())),
                          Output(&held->token, 1, one, owner_of(held)));
}

float *data_of(const Target &target, int64_t size) {
    if (!target) return nullptr;
    require(int64_t(target->size()) == size, "splat: a gradient has the wrong shape");
    return target->data();
}

void backward(Token token, Gradient<4> rgb, Gradient<3> alpha, Gradient<3> depth, Target means,
              Target quaternions, Target scales, Target opacities, Target colors, Target offsets, Target background, Target poses) {
    const State &state = state_of(token);
    const SceneHandle &handle = state.handle;
    const Scene &scene = handle.scene;
    auto fits = [&](const auto &gradient) {
        return !gradient || (int64_t(gradient->shape(0)) == scene.images() && int64_t(gradient->shape(1)) == scene.height &&
                             int64_t(gradient->shape(2)) == scene.width);
    };
    require(fits(rgb) && fits(alpha) && fits(depth) && (!rgb || int64_t(rgb->shape(3)) == scene.channels) && (!depth || scene.depth),
            "splat: a gradient of an image has the wrong shape");
    splat::Backward in{state.records, state.bins, state.masks, state.used};
    if (rgb) in.rgb = {rgb->data(), rgb->stride(0), rgb->stride(1), rgb->stride(2), rgb->stride(3)};
    if (alpha) in.alpha = {alpha->data(), alpha->stride(0), alpha->stride(1), alpha->stride(2), 0};
    if (depth) in.depths = {depth->data(), depth->stride(0), depth->stride(1), depth->stride(2), 0};

    splat::ParameterGradients out{state.bins.slots};
    out.means = data_of(means, int64_t(handle.arrays.means.size()));
    out.quaternions = data_of(quaternions, int64_t(handle.arrays.quaternions.size()));
    out.scales = data_of(scales, int64_t(handle.arrays.scales.size()));
    out.opacities = data_of(opacities, int64_t(handle.arrays.opacities.size()));
    out.colors = data_of(colors, int64_t(handle.arrays.colors.size()));
    out.offsets = data_of(offsets, scene.items() * 2);
    float *const to_background = data_of(background, scene.images() * scene.channels), *const to_poses = data_of(poses, scene.images() * 16);
    nb::gil_scoped_release release;

    Arena scratch;
    std::vector<int> channels;
    std::vector<float *> slots(size_t(scene.groups()));
    for (int group = 0; group < scene.groups(); ++group) {
        const int width = scene.width_of(group) - (group + 1 == scene.groups() && scene.depth && !depth);
        if (width == 0) break;   // a group of the depth alone
        channels.push_back(width);
        scratch.reserve(slots[size_t(group)], state.entries * (splat::MOMENTS + width));
    }
    int64_t longest = 0;
    for (int64_t tile = 0; tile < state.tiles; ++tile)
        longest = std::max<int64_t>(longest, state.bins.tiles[tile + 1] - state.bins.tiles[tile]);
    in.scratch_floats = MESHANIM_DISPATCH(splat_scratch, longest);
    scratch.reserve(in.scratch, in.scratch_floats * scene.threads);
    if (to_background) scratch.reserve(in.background, state.tiles * scene.channels);
    if (to_poses) scratch.reserve(out.poses, scene.images() * scene.chunks() * 12);
    scratch.allocate();
    out.groups = slots.data(), out.channels = channels.data(), out.n_groups = int(channels.size());
    team::run(scene.threads, [&](const team::Member &member) {
        for (int group = 0; group < out.n_groups; ++group) {
            splat::Backward part = in;
            part.group = group, part.channels = channels[size_t(group)], part.slots = slots[size_t(group)];
            MESHANIM_DISPATCH(splat_blend_backward, scene, member, part);
            team::wait(member);
        }
        MESHANIM_DISPATCH(splat_project_backward, scene, member, out);
    });

    const int64_t of_image = state.tiles / scene.images();
    for (int64_t image = 0; image < scene.images(); ++image) {
        for (int64_t channel = 0; to_background && channel < scene.channels; ++channel) {
            double sum = 0;
            for (int64_t tile = 0; tile < of_image; ++tile) sum += in.background[(image * of_image + tile) * scene.channels + channel];
            to_background[image * scene.channels + channel] = float(sum);
        }
        for (int j = 0; to_poses && j < 16; ++j) {
            double sum = 0;
            for (int64_t chunk = 0; j < 12 && chunk < scene.chunks(); ++chunk) sum += out.poses[(image * scene.chunks() + chunk) * 12 + j];
            to_poses[image * 16 + j] = float(sum);
        }
    }
}

// Pixels, visible or not, for which a Gaussian's alpha was computed: whole blocks.
int64_t pairs(Token token) {
    const State &state = state_of(token);
    int64_t blocks = 0;
    for (int64_t tile = 0; tile < state.tiles; ++tile)
        for (int64_t i = 0; i < state.used[tile]; ++i)
            for (uint32_t mask = state.masks[state.bins.tiles[tile] + i]; mask; mask &= mask - 1) ++blocks;
    return blocks * splat::BLOCK * splat::BLOCK;
}

}  // namespace

void bind_splat(nb::module_ &m) {
    nb::class_<SceneHandle>(m, "SplatScene", "Gaussians, cameras and options as the splatting kernels read them.")
        .def(nb::init<Rows<3>, Rows<4>, Rows<3>, Values, Contiguous<const float, nb::shape<-1, -1, -1>>, int, Poses, Intrinsics, Values,
                      int64_t, int, int, float, float, float, float, bool, bool, int>(),
             "means"_a.noconvert(), "quaternions"_a.noconvert(), "scales"_a.noconvert(), "opacities"_a.noconvert(),
             "colors"_a.noconvert(), "coefficients"_a, "poses"_a.noconvert(), "intrinsics"_a.noconvert(),
             "background"_a.noconvert(), "cameras"_a, "width"_a, "height"_a, "near"_a, "far"_a, "eps2d"_a, "max_alpha"_a,
             "antialiased"_a, "depth"_a, "threads"_a);
    m.def("splat_forward", &forward, "scene"_a,
          "(finite, planes (images, channels [+ depth] + alpha, height, width), radii (images, N, 2), state).");
    m.def("splat_pairs", &pairs, "state"_a.noconvert(), "How many pairs of pixel and Gaussian were computed.");
    m.def("fused_multiply_adds", [](int64_t rounds, int threads) {
        std::vector<float> sums(size_t(std::max(threads, 1)));
        return MESHANIM_DISPATCH(fused_multiply_adds, rounds, std::max(threads, 1), sums.data());
    }, "rounds"_a, "threads"_a, "Keep the processor busy in registers; returns the operations done, to be timed.");
    m.def("splat_backward", &backward, "state"_a.noconvert(), "rgb"_a.none(), "alpha"_a.none(), "depth"_a.none(),
          "means"_a.none(), "quaternions"_a.none(), "scales"_a.none(), "opacities"_a.none(), "colors"_a.none(), "offsets"_a.none(),
          "background"_a.none(), "poses"_a.none(), "Gradients of the images to those of the parameters, written into what is given.");
}
