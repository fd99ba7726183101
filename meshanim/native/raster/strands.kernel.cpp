// Hair as anti-aliased lines with sub-pixel width, lit by Kajiya and Kay's model (1989), drawn back to front.
#include <algorithm>
#include <cmath>
#include <vector>

#include "raster.h"
#include "vector.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace raster;

constexpr int BAND = 16;
constexpr float BIAS = 0.001f;               // metres by which a strand may lie behind the surface
constexpr float BURIED = 0.012f;             // a strand whose points all lie deeper is not drawn
constexpr float OPACITY_OF_A_STRAND = 0.9f;

constexpr float SPENT = 1 / 1024.0f;          // a pixel that lets less light through is full
constexpr int POINTS = 16;                   // of a strand, at most

struct Point {
    float x, y, z;
    Vec color;
};

struct Item {
    float depth;
    int32_t strand;
    int32_t low, high;                       // rows
    int32_t left, right;                     // columns
};

struct Offset {
    int64_t value;
};

// Strands of one band of rows, nearest first: light so far and what still passes. Where a nearer surface hides some of
// a pixel's samples, strands gather in `behind`, so that many of them do not wear away the surface's edge; `share` is
// the part of the pixel that they can be seen in.
struct Layer {
    float light[3] = {0, 0, 0}, through = 1;

    void put_behind(Vec color, float cover) {
        const float c = cover * through;
        light[0] += c * color.x, light[1] += c * color.y, light[2] += c * color.z;
        through -= c;
    }
};

struct Pixel {
    Layer front, behind;
    float share = 0;
};

inline void merge(const Pixel &strands, float *planes, int64_t area, int64_t pixel) {
    float &opacity = planes[OPACITY * area + pixel];
    const float empty = 1 - std::min(opacity, 1.0f), hidden = std::max(0.0f, strands.share - empty);
    const float behind = 1 - strands.behind.through, through = strands.front.through;
    const float keep = 1 - std::min(1.0f, hidden / std::max(opacity, 1e-3f)) * behind;
    for (int k = 0; k < 3; ++k) {
        float &light = planes[(LIGHT + k) * area + pixel];
        light = (light * keep + strands.share * strands.behind.light[k]) * through + strands.front.light[k];
    }
    const float below = std::min(1.0f, opacity * keep + strands.share * behind);
    opacity = below * through + 1 - through;
}

// The points of one strand, a coordinate an array; unused places hold zeros.
struct Triples {
    float x[POINTS], y[POINTS], z[POINTS];
};

// Light at each point of a strand; `lanes` is its number of points, rounded up to eight.
void shine(const Lighting &lighting, Vec color, const Triples &tangent, const Triples &normal, Vec view, const float *occlusion,
           float lit, int lanes, Triples &sum) {
    const Vec base = color * load(lighting.sky) * 0.8f, tint = Vec{0.006f, 0.006f, 0.006f} + color * 0.10f;
    for (int k = 0; k < lanes; ++k) sum.x[k] = base.x, sum.y[k] = base.y, sum.z[k] = base.z;
    for (int j = 0; j < lighting.n; ++j) {
        const Vec l = load(lighting.direction[j]), h = unit(l + view), light = load(lighting.color[j]);
        const float amount = j == lighting.shadowed ? lit : 1.0f;
        const Vec soft = color * light * 0.36f, hard = tint * light;
#pragma omp simd
        for (int k = 0; k < lanes; ++k) {
            const float tl = tangent.x[k] * l.x + tangent.y[k] * l.y + tangent.z[k] * l.z;
            const float th = tangent.x[k] * h.x + tangent.y[k] * h.y + tangent.z[k] * h.z;
            const float nl = normal.x[k] * l.x + normal.y[k] * l.y + normal.z[k] * l.z;
            const float facing = std::min(1.0f, std::max(0.0f, (nl + 0.25f) * 0.8f)) * amount;
            const float diffuse = std::sqrt(std::max(0.0f, 1 - tl * tl)) * facing;
            const float s = std::max(0.0f, 1 - th * th), s2 = s * s, s4 = s2 * s2, s16 = s4 * s4 * s4 * s4;
            const float highlight = s16 * s4 * facing;
            sum.x[k] += soft.x * diffuse + hard.x * highlight;
            sum.y[k] += soft.y * diffuse + hard.y * highlight;
            sum.z[k] += soft.z * diffuse + hard.z * highlight;
        }
    }
    for (int k = 0; k < lanes; ++k) sum.x[k] *= occlusion[k], sum.y[k] *= occlusion[k], sum.z[k] *= occlusion[k];
}

float lit_at(const View &light, const float *map, Vec p) {
    const double *m = light.world_to_camera;
    const float x = float((m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3]) * light.fx + light.cx);
    const float y = float((m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7]) * light.fy + light.cy);
    const float z = float(m[8] * p.x + m[9] * p.y + m[10] * p.z + m[11]) - 0.002f;
    const float reach = 0.0015f * float(light.fx);
    float sum = 0;
    for (int k = 0; k < 4; ++k) {
        const int i = int(std::floor(x + (k & 1 ? reach : -reach))), j = int(std::floor(y + (k & 2 ? reach : -reach)));
        if (i < 0 || j < 0 || i >= light.width || j >= light.height || map[int64_t(j) * light.width + i] > z) sum += 0.25f;
    }
    return sum;
}

struct Reach {                               // depths of the nearest and the farthest sample of a pixel
    float near = INFINITY, far = -INFINITY;
};

}  // namespace

// Draws over the LIGHT and OPACITY planes. depth: visibility samples of the surface.
void draw_strands(const Mesh &mesh, const Strands &strands, const View &view, const Lighting &lighting, const View &light,
                  const float *map, const float *depth, int samples, float *planes, int threads) {
    const int width = view.width, height = view.height, count = strands.points, lanes = (count + 7) / 8 * 8;
    const int64_t area = int64_t(width) * height;
    const double *m = view.world_to_camera;
    const Vec rows[3] = {{float(m[0]), float(m[1]), float(m[2])}, {float(m[4]), float(m[5]), float(m[6])}, {float(m[8]), float(m[9]), float(m[10])}};
    const Vec shift{float(m[3]), float(m[7]), float(m[11])};
    const Vec eye = (rows[0] * shift.x + rows[1] * shift.y + rows[2] * shift.z) * -1.0f;
    const float fx = float(view.fx), skew = float(view.skew), cx = float(view.cx), fy = float(view.fy), cy = float(view.cy), focal = fx;
    std::vector<Point> points(strands.n * count);
    std::vector<Item> items(strands.n);
    const auto surface = [&](int x, int y) { return depth[int64_t(y) * samples * width * samples + x * samples]; };
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < strands.n; ++i) {
        Item &item = items[i];
        item = {0, int32_t(i), 1 << 30, -1, 0, 0};
        const int32_t *f = mesh.faces + 3 * int64_t(strands.triangle[i]);
        const float *w = strands.barycentric + 3 * i;
        const Vec a = load(mesh.vertices + 3 * f[0]), b = load(mesh.vertices + 3 * f[1]), c = load(mesh.vertices + 3 * f[2]);
        const Vec edge = unit(b - a), normal = unit(cross(edge, c - a)), side = cross(normal, edge);
        const Vec root = a * w[0] + b * w[1] + c * w[2];
        Triples offset{}, world, image, tangent, outward{}, color;
        float occlusion[POINTS] = {};
        const float *o = strands.offsets + i * (count - 1) * 3;
        for (int k = 1; k < count; ++k, o += 3) offset.x[k] = o[0], offset.y[k] = o[1], offset.z[k] = o[2];
#pragma omp simd
        for (int k = 0; k < lanes; ++k) {
            world.x[k] = root.x + edge.x * offset.x[k] + side.x * offset.y[k] + normal.x * offset.z[k];
            world.y[k] = root.y + edge.y * offset.x[k] + side.y * offset.y[k] + normal.y * offset.z[k];
            world.z[k] = root.z + edge.z * offset.x[k] + side.z * offset.y[k] + normal.z * offset.z[k];
            const float x = rows[0].x * world.x[k] + rows[0].y * world.y[k] + rows[0].z * world.z[k] + shift.x;
            const float y = rows[1].x * world.x[k] + rows[1].y * world.y[k] + rows[1].z * world.z[k] + shift.y;
            const float z = rows[2].x * world.x[k] + rows[2].y * world.y[k] + rows[2].z * world.z[k] + shift.z;
            image.x[k] = (fx * x + skew * y) / z + cx, image.y[k] = fy * y / z + cy, image.z[k] = z;
        }
        bool visible = false, near = true;
        float low = 1e9f, high = -1e9f, left = 1e9f, right = -1e9f;
        for (int k = 0; k < count; ++k) {
            const float x = image.x[k], y = image.y[k], z = image.z[k];
            near &= z > float(view.near);
            low = std::min(low, y), high = std::max(high, y), left = std::min(left, x), right = std::max(right, x);
            if (near && x >= 0 && y >= 0 && x < width && y < height) visible |= z < surface(int(x), int(y)) + BURIED;
        }
        if (!near || !visible) continue;
        const float reach = 2 + std::abs(strands.width[i]) * focal / image.z[count / 2];
        item.depth = image.z[count / 2];
        item.low = std::max(0, int(std::floor(low - reach))), item.high = std::min(height - 1, int(std::floor(high + reach)));
        item.left = std::max(0, int(std::floor(left - reach))), item.right = std::min(width - 1, int(std::floor(right + reach)));
        const float *n = strands.normals + i * count * 3;
        for (int k = 0; k < count; ++k, n += 3) {
            offset.x[k] = n[0], offset.y[k] = n[1], offset.z[k] = n[2];
            occlusion[k] = strands.occlusion[i * count + k];
        }
        for (int k = 0; k < count; ++k) {
            const int s = std::min(k, count - 2);
            tangent.x[k] = world.x[s + 1] - world.x[s], tangent.y[k] = world.y[s + 1] - world.y[s], tangent.z[k] = world.z[s + 1] - world.z[s];
        }
        for (int k = count; k < lanes; ++k) tangent.x[k] = tangent.y[k] = tangent.z[k] = 0;
#pragma omp simd
        for (int k = 0; k < lanes; ++k) {
            outward.x[k] = edge.x * offset.x[k] + side.x * offset.y[k] + normal.x * offset.z[k];
            outward.y[k] = edge.y * offset.x[k] + side.y * offset.y[k] + normal.y * offset.z[k];
            outward.z[k] = edge.z * offset.x[k] + side.z * offset.y[k] + normal.z * offset.z[k];
            const float square = tangent.x[k] * tangent.x[k] + tangent.y[k] * tangent.y[k] + tangent.z[k] * tangent.z[k];
            const float inverse = 1 / std::sqrt(square + 1e-24f);
            tangent.x[k] *= inverse, tangent.y[k] *= inverse, tangent.z[k] *= inverse;
        }
        const float lit = map ? lit_at(light, map, root + normal * 0.002f) : 1.0f;
        shine(lighting, load(strands.color + 3 * i), tangent, outward, unit(eye - root), occlusion, lit, lanes, color);
        Point *p = points.data() + i * count;
        for (int k = 0; k < count; ++k) p[k] = {image.x[k], image.y[k], image.z[k], {color.x[k], color.y[k], color.z[k]}};
    }
    items.erase(std::remove_if(items.begin(), items.end(), [](const Item &i) { return i.high < i.low || i.right < i.left; }), items.end());
    std::sort(items.begin(), items.end(), [](const Item &a, const Item &b) {
        return a.depth < b.depth || (a.depth == b.depth && a.strand > b.strand);
    });
    const int bands = (height + BAND - 1) / BAND;
    std::vector<Offset> start(bands + 1, Offset{0});
    for (const Item &i : items)
        for (int b = i.low / BAND; b <= i.high / BAND; ++b) ++start[b + 1].value;
    for (int b = 0; b < bands; ++b) start[b + 1].value += start[b].value;
    std::vector<Offset> next(start.begin(), start.end() - 1), binned(start[bands].value);
    for (const Item &i : items)
        for (int b = i.low / BAND; b <= i.high / BAND; ++b) binned[next[b].value++].value = &i - items.data();
    const float share = 1.0f / (samples * samples), segments = float(count - 1);
#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int band = 0; band < bands; ++band) {
        const int row0 = band * BAND, row1 = std::min(height, row0 + BAND);
        if (start[band].value == start[band + 1].value) continue;
        int left = width, right = 0;
        for (int64_t at = start[band].value; at < start[band + 1].value; ++at) {
            const Item &item = items[binned[at].value];
            left = std::min(left, item.left), right = std::max(right, item.right + 1);
        }
        const int columns = right - left;
        std::vector<Pixel> layers(int64_t(row1 - row0) * columns);
        std::vector<Reach> reaches(layers.size());
        for (int y = row0; y < row1; ++y)
            for (int x = left; x < right; ++x) {
                Reach &reach = reaches[int64_t(y - row0) * columns + x - left];
                for (int j = 0; j < samples; ++j)
                    for (int i = 0; i < samples; ++i) {
                        const float z = depth[(int64_t(y) * samples + j) * width * samples + x * samples + i];
                        reach.near = std::min(reach.near, z), reach.far = std::max(reach.far, z);
                    }
            }
        for (int64_t at = start[band].value; at < start[band + 1].value; ++at) {
            const int64_t strand = items[binned[at].value].strand;
            const Point *p = points.data() + strand * count;
            const float thick = strands.width[strand] * focal / p[count / 2].z;
            const float reach = std::max(thick, 1.0f) * 0.5f + 0.5f;
            for (int s = 0; s + 1 < count; ++s) {
                const Point &a = p[s], &b = p[s + 1];
                const int y0 = std::max(row0, int(std::floor(std::min(a.y, b.y) - reach)));
                const int y1 = std::min(row1 - 1, int(std::floor(std::max(a.y, b.y) + reach)));
                if (y0 > y1) continue;
                const float dx = b.x - a.x, dy = b.y - a.y, square = dx * dx + dy * dy + 1e-9f, inverse = 1 / square;
                const float low = std::min(a.x, b.x) - reach, high = std::max(a.x, b.x) + reach, across = std::sqrt(inverse);
                const bool steep = std::abs(dy) > 1e-3f;
                const float slope = steep ? dx / dy : 0, extent = steep ? reach / (across * std::abs(dy)) + 0.5f : 1e9f;
                for (int y = y0; y <= y1; ++y) {
                    const float middle = a.x + (y + 0.5f - a.y) * slope;
                    const int x0 = std::max(left, int(std::max(low, middle - extent)));
                    const int x1 = std::min(right - 1, int(std::min(high, middle + extent)));
                    Pixel *const pixels = layers.data() + int64_t(y - row0) * columns - left;
                    const Reach *const seen_to = reaches.data() + int64_t(y - row0) * columns - left;
                    for (int x = x0; x <= x1; ++x) {
                        Pixel &pixel = pixels[x];
                        if (pixel.front.through < SPENT) continue;
                        const float px = x + 0.5f - a.x, py = y + 0.5f - a.y;
                        const float t = (px * dx + py * dy) * inverse;
                        if (t < 0 || t > 1) continue;
                        const float z = a.z + t * (b.z - a.z) - BIAS;
                        if (z > seen_to[x].far) continue;
                        const float along = (s + t) / segments, w = thick * (1 - 0.75f * along * std::sqrt(along));
                        float cover = std::min(1.0f, std::max(w, 1.0f) * 0.5f + 0.5f - std::abs(px * dy - py * dx) * across);
                        cover *= std::min(1.0f, w) * OPACITY_OF_A_STRAND;
                        if (cover <= 0) continue;
                        const Vec color = a.color * (1 - t) + b.color * t;
                        if (z <= seen_to[x].near) {
                            pixel.front.put_behind(color, cover);
                            continue;
                        }
                        int seen = 0;
                        for (int j = 0; j < samples; ++j)
                            for (int i = 0; i < samples; ++i)
                                seen += z <= depth[(int64_t(y) * samples + j) * width * samples + x * samples + i];
                        pixel.behind.put_behind(color, cover);
                        pixel.share = std::max(pixel.share, seen * share);
                    }
                }
            }
        }
        for (int y = row0; y < row1; ++y)
            for (int x = left; x < right; ++x) {
                const Pixel &pixel = layers[int64_t(y - row0) * columns + x - left];
                if (pixel.front.through + pixel.behind.through < 2) merge(pixel, planes, area, int64_t(y) * width + x);
            }
    }
}

}  // namespace MESHANIM_NAMESPACE
