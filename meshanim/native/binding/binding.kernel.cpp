// Local to world for Gaussians on triangles, and back for the gradients.
//
// A triangle's frame is kept as eight floats: the quaternion of its rotation, its scale, its origin. The backward
// pass turns what reaches a Gaussian into a force, a torque and a stretch on its triangle, sums them a triangle,
// and hands them to the corners; sums run over lists in a fixed order, so results do not depend on threads.
// Rows are turned into columns a tile at a time; loops over a tile are whole vectors, which the compiler sees.
#include "binding.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "isa.h"

#if defined(__GNUC__)
#define MESHANIM_NOINLINE __attribute__((noinline))
#else
#define MESHANIM_NOINLINE
#endif

namespace MESHANIM_NAMESPACE {
namespace {

constexpr int TILE = 64;

template <int WIDTH> struct Columns {
    alignas(64) float at[WIDTH][TILE];
};

// n rows as columns; what lies beyond in the tile stays as it is.
template <int WIDTH> inline void unpack(const float *rows, int n, Columns<WIDTH> &tile) {
    for (int i = 0; i < n; ++i)
        for (int part = 0; part < WIDTH; ++part) tile.at[part][i] = rows[WIDTH * i + part];
}
template <int WIDTH> inline void pack(const Columns<WIDTH> &tile, int n, float *rows) {
    for (int i = 0; i < n; ++i)
        for (int part = 0; part < WIDTH; ++part) rows[WIDTH * i + part] = tile.at[part][i];
}
template <int WIDTH> inline void pack(const Columns<WIDTH> &tile, int n, float *rows, bool add) {
    if (!add) return pack(tile, n, rows);
    for (int i = 0; i < n; ++i)
        for (int part = 0; part < WIDTH; ++part) rows[WIDTH * i + part] += tile.at[part][i];
}

struct Vec {
    float x, y, z;
};
struct Quat {
    float w, x, y, z;
};

template <int WIDTH> inline Vec vector(const Columns<WIDTH> &tile, int i, int first = 0) {
    return {tile.at[first][i], tile.at[first + 1][i], tile.at[first + 2][i]};
}
template <int WIDTH> inline Quat quaternion(const Columns<WIDTH> &tile, int i) {
    return {tile.at[0][i], tile.at[1][i], tile.at[2][i], tile.at[3][i]};
}
template <int WIDTH> inline void set(Columns<WIDTH> &tile, int i, Vec a, int first = 0) {
    tile.at[first][i] = a.x, tile.at[first + 1][i] = a.y, tile.at[first + 2][i] = a.z;
}
template <int WIDTH> inline void set(Columns<WIDTH> &tile, int i, Quat a) {
    tile.at[0][i] = a.w, tile.at[1][i] = a.x, tile.at[2][i] = a.y, tile.at[3][i] = a.z;
}
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Vec choose(bool first, Vec a, Vec b) {
    return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}
inline Quat choose(bool first, Quat a, Quat b) {
    return {first ? a.w : b.w, first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}
inline Quat operator*(Quat a, Quat b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
inline Quat operator*(float s, Quat a) { return {s * a.w, s * a.x, s * a.y, s * a.z}; }
inline Quat operator-(Quat a, Quat b) { return {a.w - b.w, a.x - b.x, a.y - b.y, a.z - b.z}; }
inline float dot(Quat a, Quat b) { return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z; }
inline Quat conjugate(Quat a) { return {a.w, -a.x, -a.y, -a.z}; }
inline Vec turn(Quat q, Vec a) {
    const Vec axis{q.x, q.y, q.z}, once = cross(axis, a), twice = cross(axis, once);
    return {a.x + 2 * (q.w * once.x + twice.x), a.y + 2 * (q.w * once.y + twice.y),
            a.z + 2 * (q.w * once.z + twice.z)};
}
// Finite at zero, and without a branch, which would keep loops from being vectorised.
inline float inverse_length(Quat q) { return 1.0f / std::sqrt(dot(q, q) + std::numeric_limits<float>::min()); }

// Columns of the rotation and what the sides measure, as in geometry/frames.py.
struct Triangle {
    Vec a0, a1, a2, centre;
    float length, height, along;  // of the first side; over it; of the second side along the first
    bool solid;
};

inline Triangle triangle_of(Vec v0, Vec v1, Vec v2) {
    constexpr float TINY = 1.0842022e-19f;  // square root of the least normal number
    constexpr float EPS = 16 * std::numeric_limits<float>::epsilon();
    const Vec side = v1 - v0, other = v2 - v0;
    const float side2 = dot(side, side), other2 = dot(other, other);
    const bool has_side = side2 > TINY, has_other = other2 > TINY;
    const Vec first = choose(has_side, side, choose(has_other, other, Vec{1, 0, 0}));
    const float first2 = has_side ? side2 : has_other ? other2 : 1.0f;
    Triangle t;
    t.a0 = (1.0f / std::sqrt(first2)) * first;
    const Vec normal = cross(t.a0, other);
    const float normal2 = dot(normal, normal);
    const bool has_normal = has_other & (normal2 > EPS * EPS * other2);
    // Without a normal: the coordinate axis least along the first side, made orthogonal to it.
    const float x = std::fabs(t.a0.x), y = std::fabs(t.a0.y), z = std::fabs(t.a0.z);
    const bool x_least = (x <= y) & (x <= z), y_least = !x_least & (y <= z);
    const Vec least = choose(x_least, Vec{1, 0, 0}, choose(y_least, Vec{0, 1, 0}, Vec{0, 0, 1}));
    const Vec across = least - dot(least, t.a0) * t.a0;
    const Vec upright = choose(has_normal, normal, across);
    t.a1 = (1.0f / std::sqrt(dot(upright, upright))) * upright;
    t.a2 = cross(t.a0, t.a1);
    t.length = has_side ? std::sqrt(side2) : 0.0f;
    t.height = std::fabs(dot(t.a2, other));
    t.along = dot(t.a0, other);
    t.centre = (1.0f / 3.0f) * (v0 + v1 + v2);
    t.solid = has_side & has_normal;
    return t;
}

// The largest of the four squares decides which form is taken, as in roma.
inline Quat quaternion_of(const Triangle &t) {
    const float xx = t.a0.x, yx = t.a0.y, zx = t.a0.z, xy = t.a1.x, yy = t.a1.y, zy = t.a1.z, xz = t.a2.x,
                yz = t.a2.y, zz = t.a2.z;
    const float trace = xx + yy + zz;
    const Quat by_x{zy - yz, 1 - trace + 2 * xx, yx + xy, zx + xz};
    const Quat by_y{xz - zx, yx + xy, 1 - trace + 2 * yy, zy + yz};
    const Quat by_z{yx - xy, zx + xz, zy + yz, 1 - trace + 2 * zz};
    const Quat by_w{1 + trace, zy - yz, xz - zx, yx - xy};
    const bool y_wins = yy > xx;
    const float best_xy = y_wins ? yy : xx;
    const bool z_wins = zz > best_xy;
    const float best = z_wins ? zz : best_xy;
    const Quat q = choose(trace > best, by_w, choose(z_wins, by_z, choose(y_wins, by_y, by_x)));
    return inverse_length(q) * q;
}

// The corners of triangles begin to begin + n, a column a coordinate.
inline void gather_corners(const float *vertices, const int32_t *corners, int64_t begin, int n, Columns<9> &tile) {
    for (int i = 0; i < n; ++i)
        for (int corner = 0; corner < 3; ++corner) {
            const float *vertex = vertices + 3 * int64_t(corners[3 * (begin + i) + corner]);
            for (int axis = 0; axis < 3; ++axis) tile.at[3 * corner + axis][i] = vertex[axis];
        }
}

// The frames of the triangles that carry Gaussians begin to begin + n.
inline void gather_triangles(const float *triangles, const int32_t *face, int64_t begin, int n, Columns<8> &tile) {
    for (int i = 0; i < n; ++i) {
        const float *row = triangles + 8 * int64_t(face[begin + i]);
        for (int part = 0; part < 8; ++part) tile.at[part][i] = row[part];
    }
}

void triangles(const BindingForward &a, int64_t frame, int64_t begin, int n) {
    Columns<9> corners{};
    Columns<8> rows;
    gather_corners(a.vertices + 3 * frame * a.sizes.vertices, a.corners, begin, n, corners);
    for (int i = 0; i < TILE; ++i) {
        const Triangle t = triangle_of(vector(corners, i), vector(corners, i, 3), vector(corners, i, 6));
        set(rows, i, quaternion_of(t));
        rows.at[4][i] = 0.5f * (t.length + t.height);
        set(rows, i, t.centre, 5);
    }
    pack(rows, n, a.triangles + 8 * (frame * a.sizes.faces + begin));
}

// Gaussians of a tile with the frames of their triangles.
struct Tile {
    Columns<8> triangles;
    Columns<3> means, scales;
    Columns<4> quaternions;

    void read(const BindingSizes &sizes, const float *all_triangles, const int32_t *face, const BindingField *fields,
              int64_t frame, int64_t begin, int n) {
        gather_triangles(all_triangles + 8 * frame * sizes.faces, face, begin, n, triangles);
        unpack(fields[0].at(frame) + 3 * begin, n, means);
        unpack(fields[1].at(frame) + 4 * begin, n, quaternions);
        unpack(fields[2].at(frame) + 3 * begin, n, scales);
    }
};

struct Fields {
    Columns<3> means, scales;
    Columns<4> quaternions;
};

// Out of line, as are the gradients: inlined, what gcc knows of the tile's zeros keeps it from vectorising them.
MESHANIM_NOINLINE void to_world(const Tile &__restrict local, Fields &__restrict world) {
    for (int i = 0; i < TILE; ++i) {
        const Quat rotation = quaternion(local.triangles, i), own = quaternion(local.quaternions, i);
        const float k = local.triangles.at[4][i];
        set(world.means, i, k * turn(rotation, vector(local.means, i)) + vector(local.triangles, i, 5));
        set(world.quaternions, i, rotation * (inverse_length(own) * own));
        set(world.scales, i, k * vector(local.scales, i));
    }
}

void to_world(const BindingForward &a, int64_t frame, int64_t begin, int n) {
    Tile local{};
    Fields world;
    local.read(a.sizes, a.triangles, a.face, a.fields, frame, begin, n);
    to_world(local, world);
    const int64_t first = frame * a.sizes.gaussians + begin;
    pack(world.means, n, a.world_means + 3 * first);
    pack(world.quaternions, n, a.world_quaternions + 4 * first);
    pack(world.scales, n, a.world_scales + 3 * first);
}

// Gradients of the Gaussians' own fields; loads are torque (3) and stretch on their triangles.
MESHANIM_NOINLINE void gradients(const Tile &__restrict local, const Fields &__restrict grad_world, Fields &__restrict grad,
                                 Columns<4> &__restrict loads) {
    for (int i = 0; i < TILE; ++i) {
        const Quat rotation = quaternion(local.triangles, i), back = conjugate(rotation);
        const float k = local.triangles.at[4][i];
        const Vec pull = vector(grad_world.means, i), grow = vector(grad_world.scales, i);
        const Quat own = quaternion(local.quaternions, i), g = quaternion(grad_world.quaternions, i);
        const float inverse = inverse_length(own);
        const Quat unit = inverse * own, twist = back * g;
        set(grad.means, i, k * turn(back, pull));
        set(grad.quaternions, i, inverse * (twist - dot(unit, twist) * unit));
        set(grad.scales, i, k * grow);

        const Vec arm = turn(rotation, vector(local.means, i));
        const Quat world = rotation * unit;
        const Vec v{world.x, world.y, world.z}, gv{g.x, g.y, g.z};
        // A turn by w moves the mean by w x k arm and the quaternion by (0, w) q / 2.
        set(loads, i, k * cross(arm, pull) + 0.5f * (world.w * gv - g.w * v + cross(v, gv)));
        loads.at[3][i] = dot(arm, pull) + dot(vector(local.scales, i), grow);
    }
}

// Added to the gradients of earlier frames where frames share a field.
void gaussian_gradients(const BindingBackward &a, int64_t frame, int64_t begin, int n) {
    Tile local{};
    Fields grad_world{}, grad;
    Columns<4> loads;
    const int64_t first = frame * a.sizes.gaussians + begin;
    local.read(a.sizes, a.triangles, a.face, a.fields, frame, begin, n);
    unpack(a.grad_world_means + 3 * first, n, grad_world.means);
    unpack(a.grad_world_quaternions + 4 * first, n, grad_world.quaternions);
    unpack(a.grad_world_scales + 3 * first, n, grad_world.scales);
    gradients(local, grad_world, grad, loads);
    const BindingField &means = a.grad_fields[0], &quaternions = a.grad_fields[1], &scales = a.grad_fields[2];
    pack(grad.means, n, means.at(frame) + 3 * begin, frame && !means.stride);
    pack(grad.quaternions, n, quaternions.at(frame) + 4 * begin, frame && !quaternions.stride);
    pack(grad.scales, n, scales.at(frame) + 3 * begin, frame && !scales.stride);
    if (a.grad_vertices) pack(loads, n, a.scratch + 4 * begin);
}

// What reaches a triangle through its Gaussians, handed to its corners; a triangle without area passes on forces
// only.
void corner_gradients(const BindingBackward &a, int64_t frame, int64_t begin, int n) {
    Columns<9> corners{};
    Columns<7> sums{};  // torque, stretch, force
    gather_corners(a.vertices + 3 * frame * a.sizes.vertices, a.corners, begin, n, corners);
    const float *pulls = a.grad_world_means + 3 * frame * a.sizes.gaussians;
    const int32_t *offsets = a.gaussians_of_face.offsets + begin;
    for (int i = 0; i < n; ++i) {
        float total[7] = {};
        for (int32_t at = offsets[i]; at < offsets[i + 1]; ++at) {
            const int64_t gaussian = a.gaussians_of_face.items[at];
            for (int part = 0; part < 4; ++part) total[part] += a.scratch[4 * gaussian + part];
            for (int axis = 0; axis < 3; ++axis) total[4 + axis] += pulls[3 * gaussian + axis];
        }
        for (int part = 0; part < 7; ++part) sums.at[part][i] = total[part];
    }
    for (int i = 0; i < TILE; ++i) {
        const Triangle t = triangle_of(vector(corners, i), vector(corners, i, 3), vector(corners, i, 6));
        const Vec torque = vector(sums, i);
        const float t0 = dot(torque, t.a0), t1 = dot(torque, t.a1), t2 = dot(torque, t.a2);
        const float by_length = t.solid ? 1.0f / t.length : 0.0f, by_height = t.solid ? 1.0f / t.height : 0.0f;
        const float stretch = t.solid ? 0.5f * sums.at[3][i] : 0.0f, slope = t.along * by_length;
        // With first side e and second side d, w = a0 (a1.dd - slope a1.de) / h - a1 (a2.de) / L + a2 (a1.de) / L,
        // dL = a0.de, dh = slope a2.de - a2.dd.
        const Vec side = stretch * t.a0 + (t2 * by_length - t0 * by_height * slope) * t.a1 +
                         (stretch * slope - t1 * by_length) * t.a2;
        const Vec other = (t0 * by_height) * t.a1 - stretch * t.a2;
        const Vec third = (1.0f / 3.0f) * vector(sums, i, 4);
        set(corners, i, third - side - other);
        set(corners, i, third + side, 3);
        set(corners, i, third + other, 6);
    }
    pack(corners, n, a.scratch + 4 * a.sizes.gaussians + 9 * begin);
}

void sum_on_vertices(const BindingBackward &a, int64_t frame, int64_t begin, int n) {
    const float *corners = a.scratch + 4 * a.sizes.gaussians;
    const int32_t *offsets = a.corners_of_vertex.offsets + begin;
    float *gradient = a.grad_vertices + 3 * (frame * a.sizes.vertices + begin);
    for (int i = 0; i < n; ++i) {
        float total[3] = {};
        for (int32_t at = offsets[i]; at < offsets[i + 1]; ++at)
            for (int axis = 0; axis < 3; ++axis)
                total[axis] += corners[3 * int64_t(a.corners_of_vertex.items[at]) + axis];
        for (int axis = 0; axis < 3; ++axis) gradient[3 * i + axis] = total[axis];
    }
}

// Calls work(begin, n) for all tiles of `count` rows; within a parallel region, shared among its threads.
template <class Work> inline void for_tiles(int64_t count, Work work) {
#pragma omp for schedule(static)
    for (int64_t tile = 0; tile < (count + TILE - 1) / TILE; ++tile)
        work(tile * TILE, int(std::min<int64_t>(TILE, count - tile * TILE)));
}

}  // namespace

void binding_forward(const BindingForward &a) {
#pragma omp parallel num_threads(a.sizes.threads)
    for (int64_t frame = 0; frame < a.sizes.frames; ++frame) {
        for_tiles(a.sizes.faces, [&](int64_t begin, int n) { triangles(a, frame, begin, n); });
        for_tiles(a.sizes.gaussians, [&](int64_t begin, int n) { to_world(a, frame, begin, n); });
    }
}

void binding_backward(const BindingBackward &a) {
#pragma omp parallel num_threads(a.sizes.threads)
    for (int64_t frame = 0; frame < a.sizes.frames; ++frame) {
        for_tiles(a.sizes.gaussians, [&](int64_t begin, int n) { gaussian_gradients(a, frame, begin, n); });
        if (!a.grad_vertices) continue;
        for_tiles(a.sizes.faces, [&](int64_t begin, int n) { corner_gradients(a, frame, begin, n); });
        for_tiles(a.sizes.vertices, [&](int64_t begin, int n) { sum_on_vertices(a, frame, begin, n); });
    }
}

}  // namespace MESHANIM_NAMESPACE
