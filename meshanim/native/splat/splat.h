// Gaussian splatting: project -> bin -> blend, and back. What the stages hand to each other. A stage is called by
// every member of a team; `team::wait` follows.
//
// An *item* is a Gaussian in an image: item = image * gaussians + gaussian. An *entry* is an item in a tile. Entries
// of a tile lie together from near to far; each has a *slot* for its gradient, where the slots of an item lie
// together. So every sum is taken in one order, whatever the number of threads, and nothing needs atomics.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../team.h"

namespace splat {

constexpr int TILE = 16;            // pixels
constexpr int BLOCK = 4;            // pixels: the unit of blending
constexpr int BLOCK_COLUMNS = TILE / BLOCK, BLOCKS = BLOCK_COLUMNS * BLOCK_COLUMNS;
constexpr int RECORD = 16;          // floats of an item
constexpr int GROUP = 4;            // channels that are blended at once
constexpr int MOMENTS = 6;          // gradient sums of an entry that are about its shape
constexpr int CHUNK = 1024;         // Gaussians a task of projection
constexpr int DIGIT = 12;           // bits that a pass of sorting looks at, at most

constexpr float MIN_ALPHA = 1.0f / 255.0f;
constexpr float LOG2_MIN_ALPHA = -7.994353436858858f;
constexpr float MIN_LIGHT = 1e-4f;  // compositing stops before it
constexpr float MAX_EXTENT = 3.33f;  // standard deviations

// An item's record. With d = pixel - (X, Y), alpha = 2^(LEVEL - p^2 - q^2), p = A dx + B dy, q = C dy: the whitened
// form has no cancellation however thin a Gaussian is. LEVEL is log2 of the opacity.
enum Record { X = 0, Y = 1, A = 2, B = 3, C = 4, LEVEL = 5, PEAK = 6, DEPTH = 7, COLOR = 8 };
// PEAK: dy of the rightmost point where alpha = 1 / 255.

// A field of Gaussians: `frame` floats from one frame to the next, 0 if all frames share it.
struct Field {
    const float *data;
    int64_t frame;
};

struct Scene {
    int64_t frames, cameras, gaussians;   // images = frames * cameras
    int width, height;
    int64_t channels;                     // of colours
    int coefficients;                     // of spherical harmonics; 0: plain colours
    Field means, quaternions, scales, opacities, colors;
    const float *poses, *intrinsics, *background;   // (images, 4, 4), (images, 3, 3), (images, channels)
    float near, far, eps2d, max_alpha;
    float safe_level;                     // log2 of opacities that max_alpha surely leaves alone
    bool antialiased, depth;              // depth: one more channel
    int threads;

    int64_t images() const { return frames * cameras; }
    int64_t items() const { return images() * gaussians; }
    int64_t blended() const { return channels + depth; }
    int groups() const { return int((blended() + GROUP - 1) / GROUP); }
    int width_of(int group) const { return group + 1 < groups() ? GROUP : int(blended() - int64_t(group) * GROUP); }
    int columns() const { return (width + TILE - 1) / TILE; }
    int rows() const { return (height + TILE - 1) / TILE; }
    int64_t tiles() const { return images() * columns() * rows(); }
    int64_t chunks() const { return (gaussians + CHUNK - 1) / CHUNK; }
};

struct Entry {
    uint32_t item, slot;
};

// The tiles [x0, x1) x [y0, y1) that an item may touch.
struct Rectangle {
    uint16_t x0, x1, y0, y1;
    int count() const { return (x1 - x0) * (y1 - y0); }
};

struct Key {
    uint32_t depth, item;   // depth: the bits of the float, which for positive numbers sort like it; 0: culled
};

// What projection writes.
struct Projected {
    float *records;             // (items, RECORD)
    uint32_t *depths;           // (items,) as in Key
    Rectangle *rectangles;      // (items,)
    int32_t *radii;             // (items, 2)
    int64_t *chunk_items, *chunk_entries;   // (images * chunks,) how many are visible, how many tiles they touch
    uint8_t *chunk_bad;         // (images * chunks,) whether an input is not finite
    uint32_t *chunk_least, *chunk_most;     // (images * chunks,) range of the visible items' depths
};

// What binning sorts: visible items with keys of a range. `other` is as long as `keys`.
struct Order {
    Key *keys, *other;
    int64_t count;
    uint32_t least, most;       // depths
    int32_t *counts;            // (threads, max(tiles, 1 << DIGIT))
};

// What binning writes.
struct Bins {
    int32_t *slots;             // (items + 1,) where each item's slots begin
    int32_t *tiles;             // (tiles + 1,) where each tile's entries begin
    Entry *entries;
    int64_t count;              // of entries
};

struct Forward {
    const float *records;
    Bins bins;
    uint16_t *masks;            // (entries,) which blocks of the tile an entry reaches
    int32_t *used;              // (tiles,) entries until no pixel of the tile takes more
    float *rgb, *alpha, *depth; // (images, height, width, channels), (images, height, width); depth null if not wanted
};

// Gradients of the images: strides of (image, y, x, channel) in floats; null where there is none.
struct ImageGradient {
    const float *data;
    int64_t image, y, x, channel;
};

struct Backward {
    const float *records;
    Bins bins;
    const uint16_t *masks;
    const int32_t *used;
    int group, channels;        // which channels: `channels` of them from group * GROUP on
    ImageGradient rgb, alpha, depths;
    float *slots;               // (entries, MOMENTS + channels)
    float *background;          // (tiles, channels), partial sums; null if not wanted
    float *scratch;             // a member's is `scratch_floats` long
    int64_t scratch_floats;
};

// Gradients of the parameters, written; null where there is none. Shapes as in Scene.
struct ParameterGradients {
    const int32_t *slots;
    const float *const *groups; // the slots of each group of channels
    const int *channels;        // how many each has
    int n_groups;
    float *means, *quaternions, *scales, *opacities, *colors;
    float *offsets;             // (items, 2)
    double *poses;              // (images, chunks, 12), partial sums
};

}  // namespace splat
