// meshanim._native.splat_forward and splat_backward (gaussians/splat/native.py calls them): memory and order of the
// stages. What backward needs again lives in a `State`, held by a tensor of one float so that autograd frees it when
// it frees the graph; its memory and all scratch come from the pool.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
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

// Tensors come as addresses of contiguous float32, for an array made of each would take longer than a small image.
// The caller keeps them, those of the inputs as long as the state.
using Address = uint64_t;   // 0: none
using Token = nb::ndarray<const float, nb::shape<1>, nb::c_contig, nb::device::cpu>;

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

enum Input { MEANS, QUATERNIONS, SCALES, OPACITIES, COLORS, POSES, INTRINSICS, BACKGROUND, INPUTS };

struct SceneHandle {
    Scene scene{};

    SceneHandle(const std::array<uint64_t, INPUTS> &addresses, const std::array<int64_t, INPUTS> &sizes, int64_t images,
                int64_t cameras, int64_t gaussians, int64_t channels, int coefficients, int width, int height, float near,
                float far, float eps2d, float max_alpha, bool antialiased, bool depth, int threads) {
        require(images > 0 && cameras > 0 && images % cameras == 0 && gaussians >= 0 && channels > 0, "splat: numbers must be positive");
        require(width > 0 && height > 0 && threads > 0, "splat: sizes and threads must be positive");
        scene.frames = images / cameras, scene.cameras = cameras, scene.gaussians = gaussians;
        scene.width = width, scene.height = height;
        scene.channels = channels, scene.coefficients = coefficients;
        const int64_t of_color = coefficients ? 3 * int64_t(coefficients) : channels;
        require(coefficients == 0 || channels == 3, "splat: harmonics have three channels");
        auto input = [&](int i) { return reinterpret_cast<const float *>(addresses[size_t(i)]); };
        auto field = [&](int i, int64_t floats) -> splat::Field {
            const int64_t one = floats * gaussians, size = sizes[size_t(i)];
            require(size == one || size == one * scene.frames, "splat: a field has the wrong size");
            return {input(i), size == one ? 0 : one};
        };
        scene.means = field(MEANS, 3), scene.quaternions = field(QUATERNIONS, 4), scene.scales = field(SCALES, 3);
        scene.opacities = field(OPACITIES, 1), scene.colors = field(COLORS, of_color);
        require(sizes[POSES] == 16 * images && sizes[INTRINSICS] == 9 * images && sizes[BACKGROUND] == channels * images,
                "splat: cameras and background do not fit together");
        scene.poses = input(POSES), scene.intrinsics = input(INTRINSICS), scene.background = input(BACKGROUND);
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
bool render(const Scene &scene, State &state, const splat::Forward &images, int32_t *radii) {
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
        const splat::Forward out{state.records, state.bins, state.masks, state.used, images.rgb, images.alpha, images.depth};
        MESHANIM_DISPATCH(splat_blend, scene, member, out);
    });
    return finite;
}

template <class T> nb::capsule owner_of(T *pointer) {
    return nb::capsule(pointer, [](void *p) noexcept { delete static_cast<T *>(p); });
}

template <class T> T *at(Address address) { return reinterpret_cast<T *>(address); }

nb::tuple forward(const SceneHandle &handle, Address rgb, Address alpha, Address depth, Address radii) {
    require(!handle.scene.depth == !depth, "splat: depth needs a place, or there is none");
    splat::Forward images{};
    images.rgb = at<float>(rgb), images.alpha = at<float>(alpha), images.depth = at<float>(depth);
    auto state = std::make_unique<State>(handle);
    bool finite;
    {
        nb::gil_scoped_release release;
        finite = render(state->handle.scene, *state, images, at<int32_t>(radii));
    }
    const size_t one[] = {1};
    State *const held = state.release();
    return nb::make_tuple(finite, nb::ndarray<nb::pytorch, float, nb::device::cpu>(&held->token, 1, one, owner_of(held)));
}

using Strided = std::array<int64_t, 5>;   // an image's gradient: its address (0: none), strides of image, y, x, channel

splat::ImageGradient gradient_of(const Strided &g) { return {at<const float>(Address(g[0])), g[1], g[2], g[3], g[4]}; }

// `targets`: gradients of the inputs but the intrinsics, in their order, then of the positions in the image.
void backward(Token token, const Strided &rgb, const Strided &alpha, const Strided &depth, const std::array<Address, INPUTS> &targets) {
    const State &state = state_of(token);
    const Scene &scene = state.handle.scene;
    require(!depth[0] || scene.depth, "splat: there is no depth whose gradient could be given");
    splat::Backward in{state.records, state.bins, state.masks, state.used};
    in.rgb = gradient_of(rgb), in.alpha = gradient_of(alpha), in.depths = gradient_of(depth);
    splat::ParameterGradients out{state.bins.slots};
    out.means = at<float>(targets[0]), out.quaternions = at<float>(targets[1]), out.scales = at<float>(targets[2]);
    out.opacities = at<float>(targets[3]), out.colors = at<float>(targets[4]), out.offsets = at<float>(targets[7]);
    float *const to_poses = at<float>(targets[5]), *const to_background = at<float>(targets[6]);
    nb::gil_scoped_release release;

    Arena scratch;
    std::vector<int> channels;
    std::vector<float *> slots(size_t(scene.groups()));
    for (int group = 0; group < scene.groups(); ++group) {
        const int width = scene.width_of(group) - (group + 1 == scene.groups() && scene.depth && !depth[0]);
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
        .def(nb::init<const std::array<Address, INPUTS> &, const std::array<int64_t, INPUTS> &, int64_t, int64_t, int64_t, int64_t, int,
                      int, int, float, float, float, float, bool, bool, int>(),
             "addresses"_a, "sizes"_a, "images"_a, "cameras"_a, "gaussians"_a, "channels"_a, "coefficients"_a, "width"_a, "height"_a,
             "near"_a, "far"_a, "eps2d"_a, "max_alpha"_a, "antialiased"_a, "depth"_a, "threads"_a,
             "addresses, sizes: of means, quaternions, scales, opacities, colors, poses, intrinsics, background.");
    m.def("splat_forward", &forward, "scene"_a, "rgb"_a, "alpha"_a, "depth"_a, "radii"_a,
          "Writes images (images, height, width, channels), (images, height, width) and radii (images, N, 2); returns "
          "(finite, state).");
    m.def("splat_pairs", &pairs, "state"_a.noconvert(), "How many pairs of pixel and Gaussian were computed.");
    m.def("fused_multiply_adds", [](int64_t rounds, int threads) {
        std::vector<float> sums(size_t(std::max(threads, 1)));
        return MESHANIM_DISPATCH(fused_multiply_adds, rounds, std::max(threads, 1), sums.data());
    }, "rounds"_a, "threads"_a, "Keep the processor busy in registers; returns the operations done, to be timed.");
    m.def("splat_backward", &backward, "state"_a.noconvert(), "rgb"_a, "alpha"_a, "depth"_a, "targets"_a,
          "Writes gradients of means, quaternions, scales, opacities, colors, poses, background and positions in the image, where "
          "there is an address; the images' own come as (address, strides of image, y, x, channel).");
}
