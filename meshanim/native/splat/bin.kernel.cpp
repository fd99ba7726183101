// Binning: visible items by depth (radix sort), then stably into tiles (counting sort). One order for any number of
// threads: a thread takes a range of what is to be sorted and knows how many of each kind the ranges before it hold.
#include <cstring>

#include "isa.h"
#include "splat.h"

namespace MESHANIM_NAMESPACE {
namespace {

using splat::Entry;
using splat::Key;
using splat::Rectangle;
using splat::Scene;

struct Range {
    int64_t begin, end;
    Range(int64_t count, int part, int parts) : begin(count * part / parts), end(count * (part + 1) / parts) {}
};

// How many members sort so many keys. The others only wait.
int parts_of(int64_t count, const team::Member &member) {
    const int64_t most = count / 4096 + 1;
    return int(most < member.size ? most : member.size);
}

// counts[part][kind] to where each part puts its first of each kind; ends with the total.
void prefix(int32_t *counts, int64_t kinds, int parts, int32_t *starts) {
    int64_t total = 0;
    for (int64_t kind = 0; kind < kinds; ++kind) {
        if (starts) starts[kind] = int32_t(total);
        for (int part = 0; part < parts; ++part) {
            const int32_t count = counts[part * kinds + kind];
            counts[part * kinds + kind] = int32_t(total);
            total += count;
        }
    }
    if (starts) starts[kinds] = int32_t(total);
}

}  // namespace

// Key the visible items in their order, and give every item its slots. The chunks' counts have become their beginnings.
void splat_collect(const Scene &scene, const team::Member &member, const splat::Projected &projected, Key *keys, int32_t *slots) {
    const int64_t chunks = scene.chunks();
    team::each(member, scene.images() * chunks, [&](int64_t task) {
        const int64_t begin = task / chunks * scene.gaussians + task % chunks * splat::CHUNK;
        const int64_t rest = scene.gaussians - task % chunks * splat::CHUNK;
        const int64_t end = begin + (rest < splat::CHUNK ? rest : splat::CHUNK);
        int64_t key = projected.chunk_items[task];
        int32_t slot = int32_t(projected.chunk_entries[task]);
        for (int64_t item = begin; item < end; ++item) {
            slots[item] = slot;
            slot += projected.rectangles[item].count();
            if (projected.depths[item]) keys[key++] = {projected.depths[item], uint32_t(item)};
        }
    });
}

// Sorts by depth, stably. Returns where the result is.
Key *splat_sort(const Scene &, const team::Member &member, const splat::Order &order) {
    const int parts = parts_of(order.count, member), part = member.rank;
    const Range range = part < parts ? Range(order.count, part, parts) : Range(0, 0, 1);
    Key *keys = order.keys, *other = order.other;
    int bits = 0;   // of the keys, above the least
    while (order.count && bits < 32 && (order.most - order.least) >> bits) ++bits;
    const int passes = (bits + splat::DIGIT - 1) / splat::DIGIT;
    const int digit = passes ? (bits + passes - 1) / passes : 0, kinds = 1 << digit;
    for (int pass = 0; pass < passes; ++pass) {
        auto kind = [&](int64_t i) { return ((keys[i].depth - order.least) >> (pass * digit)) & uint32_t(kinds - 1); };
        int32_t *const counts = order.counts + part * kinds;
        if (part < parts) {
            std::memset(counts, 0, sizeof(int32_t) * size_t(kinds));
            for (int64_t i = range.begin; i < range.end; ++i) ++counts[kind(i)];
        }
        team::wait(member);
        if (part == 0) prefix(order.counts, kinds, parts, nullptr);
        team::wait(member);
        for (int64_t i = range.begin; i < range.end; ++i) other[counts[kind(i)]++] = keys[i];
        team::wait(member);
        Key *const swapped = keys;
        keys = other, other = swapped;
    }
    return keys;
}

// Entries of every tile, from near to far.
void splat_fill(const Scene &scene, const team::Member &member, const splat::Order &order, const Key *keys,
                const Rectangle *rectangles, const splat::Bins &out) {
    const int parts = parts_of(order.count, member), part = member.rank;
    const Range range = part < parts ? Range(order.count, part, parts) : Range(0, 0, 1);
    const int64_t tiles = scene.tiles(), columns = scene.columns(), of_image = columns * scene.rows();
    const uint32_t gaussians = uint32_t(scene.gaussians);
    const bool several = scene.images() > 1;
    int32_t *const of_part = order.counts + part * tiles;
    if (part < parts) std::memset(of_part, 0, sizeof(int32_t) * size_t(tiles));
    auto first_tile = [&](uint32_t item, Rectangle box) {
        return (several ? int64_t(item / gaussians) * of_image : 0) + box.y0 * columns + box.x0;
    };
    // Most boxes are of at most two by two tiles, and which of the four is a coin toss: all four are counted, those
    // that are not there by nought, and written, those that are not there to `nowhere`.
    auto small = [](Rectangle box) { return box.x1 - box.x0 <= 2 && box.y1 - box.y0 <= 2; };
    for (int64_t i = range.begin; i < range.end; ++i) {
        const Rectangle box = rectangles[keys[i].item];
        int32_t *const tile = of_part + first_tile(keys[i].item, box);
        if (small(box)) {
            const int wide = box.x1 - box.x0 - 1, high = box.y1 - box.y0 - 1;
            tile[0] += 1;
            tile[wide] += wide;
            tile[high * columns] += high;
            tile[high * columns + wide] += wide & high;
            continue;
        }
        for (int y = 0; y < box.y1 - box.y0; ++y)
            for (int x = 0; x < box.x1 - box.x0; ++x) ++tile[y * columns + x];
    }
    team::wait(member);
    if (part == 0) prefix(order.counts, tiles, parts, out.tiles);
    team::wait(member);
    Entry nowhere;
    for (int64_t i = range.begin; i < range.end; ++i) {
        const uint32_t item = keys[i].item;
        const Rectangle box = rectangles[item];
        int32_t *const tile = of_part + first_tile(item, box);
        uint32_t slot = uint32_t(out.slots[item]);
        if (small(box)) {
            const int wide = box.x1 - box.x0 - 1, high = box.y1 - box.y0 - 1;
            auto write = [&](int32_t &place, int there) {
                Entry *const entry = there ? out.entries + place : &nowhere;
                *entry = {item, slot};
                place += there, slot += uint32_t(there);
            };
            write(tile[0], 1);
            write(tile[wide], wide);
            write(tile[high * columns], high);
            write(tile[high * columns + wide], wide & high);
            continue;
        }
        for (int y = 0; y < box.y1 - box.y0; ++y)
            for (int x = 0; x < box.x1 - box.x0; ++x) out.entries[tile[y * columns + x]++] = {item, slot++};
    }
}

}  // namespace MESHANIM_NAMESPACE
