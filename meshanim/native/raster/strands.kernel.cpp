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

struct Point {
    float x, y, z;
    Vec color;
};

struct Item {
    float depth;
    int32_t strand;
    int32_t low, high;                       // rows
};

struct Offset {
    int64_t value;
};

// Strands of one band of rows. Where a nearer surface hides some of a pixel's samples, strands gather in `behind`, so
// that many of them do not wear away the surface's edge; `share` is the part of the pixel that they can be seen in.
struct Layer {
    float light[3], opacity;
};

struct Pixel {
    Layer front, behind;
    float share;
};

inline void over(Layer &layer, const float *color, float cover) {
    for (int k = 0; k < 3; ++k) layer.light[k] += cover * (color[k] - layer.light[k]);
    layer.opacity += cover * (1 - layer.opacity);
}

inline void merge(const Pixel &strands, float *planes, int64_t area, int64_t pixel) {
    float &opacity = planes[OPACITY * area + pixel];
    const float empty = 1 - std::min(opacity, 1.0f), hidden = std::max(0.0f, strands.share - empty);
    const float keep = 1 - std::min(1.0f, hidden / std::max(opacity, 1e-3f)) * strands.behind.opacity;
    const float through = 1 - strands.front.opacity;
    for (int k = 0; k < 3; ++k) {
        float &light = planes[(LIGHT + k) * area + pixel];
        light = (light * keep + strands.share * strands.behind.light[k]) * through + strands.front.light[k];
    }
    const float below = std::min(1.0f, opacity * keep + strands.share * strands.behind.opacity);
    opacity = below * through + strands.front.opacity;
}

inline float power40(float x) {
    const float x2 = x * x, x4 = x2 * x2, x8 = x4 * x4, x16 = x8 * x8;
    return x16 * x16 * x8;
}

Vec shine(const Lighting &lighting, Vec color, Vec tangent, Vec normal, Vec view, float occlusion, float lit) {
    Vec sum = color * load(lighting.sky) * 0.8f;
    for (int j = 0; j < lighting.n; ++j) {
        const Vec l = load(lighting.direction[j]), h = unit(l + view);
        const float tl = dot(tangent, l), th = dot(tangent, h);
        const float facing = clamp((dot(normal, l) + 0.25f) / 1.25f, 0.0f, 1.0f) * (j == lighting.shadowed ? lit : 1.0f);
        const float diffuse = 0.36f * std::sqrt(std::max(0.0f, 1 - tl * tl));
        const float highlight = power40(std::sqrt(std::max(0.0f, 1 - th * th)));
        const Vec specular = (Vec{0.006f, 0.006f, 0.006f} + color * 0.10f) * highlight;
        sum = sum + (color * diffuse + specular) * load(lighting.color[j]) * facing;
    }
    return sum * occlusion;
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

}  // namespace

// Draws over the LIGHT and OPACITY planes. depth: visibility samples of the surface.
void draw_strands(const Mesh &mesh, const Strands &strands, const View &view, const Lighting &lighting, const View &light,
                  const float *map, const float *depth, int samples, float *planes, int threads) {
    const int width = view.width, height = view.height, count = strands.points;
    const int64_t area = int64_t(width) * height;
    const double *m = view.world_to_camera;
    const Vec rows[3] = {{float(m[0]), float(m[1]), float(m[2])}, {float(m[4]), float(m[5]), float(m[6])}, {float(m[8]), float(m[9]), float(m[10])}};
    const Vec shift{float(m[3]), float(m[7]), float(m[11])};
    const Vec eye = (rows[0] * shift.x + rows[1] * shift.y + rows[2] * shift.z) * -1.0f;
    std::vector<Point> points(strands.n * count);
    std::vector<Item> items(strands.n);
    const auto surface = [&](int x, int y) { return depth[int64_t(y) * samples * width * samples + x * samples]; };
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < strands.n; ++i) {
        Item &item = items[i];
        item = {0, int32_t(i), 1 << 30, -1};
        const int32_t *f = mesh.faces + 3 * int64_t(strands.triangle[i]);
        const float *w = strands.barycentric + 3 * i;
        const Vec a = load(mesh.vertices + 3 * f[0]), b = load(mesh.vertices + 3 * f[1]), c = load(mesh.vertices + 3 * f[2]);
        const Vec edge = unit(b - a), normal = unit(cross(edge, c - a)), side = cross(normal, edge);
        const Vec root = a * w[0] + b * w[1] + c * w[2];
        Point *p = points.data() + i * count;
        Vec world[16];
        bool visible = false, near = true;
        float low = 1e9f, high = -1e9f;
        for (int k = 0; k < count; ++k) {
            world[k] = root;
            if (k) {
                const float *o = strands.offsets + (i * (count - 1) + k - 1) * 3;
                world[k] = root + edge * o[0] + side * o[1] + normal * o[2];
            }
            const Vec q = Vec{dot(rows[0], world[k]), dot(rows[1], world[k]), dot(rows[2], world[k])} + shift;
            near &= q.z > float(view.near);
            p[k].x = float((view.fx * q.x + view.skew * q.y) / q.z + view.cx);
            p[k].y = float(view.fy * q.y / q.z + view.cy);
            p[k].z = q.z;
            low = std::min(low, p[k].y), high = std::max(high, p[k].y);
            if (near && p[k].x >= 0 && p[k].y >= 0 && p[k].x < width && p[k].y < height)
                visible |= q.z < surface(int(p[k].x), int(p[k].y)) + BURIED;
        }
        if (!near || !visible) continue;
        item.depth = p[count / 2].z;
        item.low = std::max(0, int(std::floor(low - 2))), item.high = std::min(height - 1, int(std::floor(high + 2)));
        const Vec color = load(strands.color + 3 * i), view_direction = unit(eye - root);
        const float lit = map ? lit_at(light, map, root + normal * 0.002f) : 1.0f;
        for (int k = 0; k < count; ++k) {
            const Vec tangent = unit(k + 1 < count ? world[k + 1] - world[k] : world[k] - world[k - 1]);
            const float *n = strands.normals + (i * count + k) * 3;
            const Vec outward = edge * n[0] + side * n[1] + normal * n[2];
            p[k].color = shine(lighting, color, tangent, outward, view_direction, strands.occlusion[i * count + k], lit);
        }
    }
    items.erase(std::remove_if(items.begin(), items.end(), [](const Item &i) { return i.high < i.low; }), items.end());
    std::sort(items.begin(), items.end(), [](const Item &a, const Item &b) {
        return a.depth > b.depth || (a.depth == b.depth && a.strand < b.strand);
    });
    const int bands = (height + BAND - 1) / BAND;
    std::vector<Offset> start(bands + 1, Offset{0});
    for (const Item &i : items)
        for (int b = i.low / BAND; b <= i.high / BAND; ++b) ++start[b + 1].value;
    for (int b = 0; b < bands; ++b) start[b + 1].value += start[b].value;
    std::vector<Offset> next(start.begin(), start.end() - 1), binned(start[bands].value);
    for (const Item &i : items)
        for (int b = i.low / BAND; b <= i.high / BAND; ++b) binned[next[b].value++].value = i.strand;
    const float share = 1.0f / (samples * samples), segments = float(count - 1), focal = float(view.fx);
#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int band = 0; band < bands; ++band) {
        const int row0 = band * BAND, row1 = std::min(height, row0 + BAND);
        if (start[band].value == start[band + 1].value) continue;
        std::vector<Pixel> layers(int64_t(row1 - row0) * width, Pixel{});
        for (int64_t at = start[band].value; at < start[band + 1].value; ++at) {
            const int64_t strand = binned[at].value;
            const Point *p = points.data() + strand * count;
            const float thick = strands.width[strand] * focal / p[count / 2].z;
            for (int s = 0; s + 1 < count; ++s) {
                const Point &a = p[s], &b = p[s + 1];
                const float dx = b.x - a.x, dy = b.y - a.y, square = dx * dx + dy * dy + 1e-9f, inverse = 1 / square;
                const float reach = std::max(thick, 1.0f) * 0.5f + 0.5f;
                const int y0 = std::max(row0, int(std::floor(std::min(a.y, b.y) - reach)));
                const int y1 = std::min(row1 - 1, int(std::floor(std::max(a.y, b.y) + reach)));
                const float left = std::min(a.x, b.x) - reach, right = std::max(a.x, b.x) + reach;
                const float slope = std::abs(dy) > 1e-3f ? dx / dy : 0, extent = std::abs(dy) > 1e-3f ? reach * std::sqrt(square) / std::abs(dy) + 0.5f : 1e9f;
                for (int y = y0; y <= y1; ++y) {
                    const float middle = a.x + (y + 0.5f - a.y) * slope;
                    const int x0 = std::max(0, int(std::max(left, middle - extent)));
                    const int x1 = std::min(width - 1, int(std::min(right, middle + extent)));
                    for (int x = x0; x <= x1; ++x) {
                        const float t = ((x + 0.5f - a.x) * dx + (y + 0.5f - a.y) * dy) * inverse;
                        if (t < 0 || t > 1) continue;
                        const float ex = x + 0.5f - a.x - t * dx, ey = y + 0.5f - a.y - t * dy;
                        const float along = (s + t) / segments, w = thick * (1 - 0.75f * along * std::sqrt(along));
                        float cover = std::min(1.0f, std::max(0.0f, std::max(w, 1.0f) * 0.5f + 0.5f - std::sqrt(ex * ex + ey * ey)));
                        cover *= std::min(1.0f, w) * OPACITY_OF_A_STRAND;
                        if (cover <= 0) continue;
                        const float z = a.z + t * (b.z - a.z) - BIAS;
                        int seen = 0;
                        for (int j = 0; j < samples; ++j)
                            for (int i = 0; i < samples; ++i)
                                seen += z <= depth[(int64_t(y) * samples + j) * width * samples + x * samples + i];
                        if (!seen) continue;
                        const Vec color = a.color * (1 - t) + b.color * t;
                        const float value[3] = {color.x, color.y, color.z};
                        Pixel &pixel = layers[int64_t(y - row0) * width + x];
                        over(seen == samples * samples ? pixel.front : pixel.behind, value, cover);
                        if (seen < samples * samples) pixel.share = std::max(pixel.share, seen * share);
                    }
                }
            }
        }
        for (int64_t i = 0; i < int64_t(layers.size()); ++i)
            if (layers[i].front.opacity + layers[i].behind.opacity > 0) merge(layers[i], planes, area, int64_t(row0) * width + i);
    }
}

}  // namespace MESHANIM_NAMESPACE
