// Deferred shading. A row's visibility samples are grouped into fragments (one a pixel inside a surface, more on
// edges); materials are fetched a fragment at a time, lights run over the row's fragments as one vector loop.
#include <algorithm>
#include <cmath>
#include <vector>

#include "fragments.h"
#include "raster.h"
#include "simd.h"
#include "vector.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace raster;

constexpr float PI = 3.14159265f;
constexpr float SPECULAR_NORMAL = 0.028f;    // Fresnel reflectance of skin at normal incidence
constexpr float INSIDE = 0.15f;              // light that reaches the inner side of an open surface
constexpr float SAME_SURFACE = 0.0025f;      // metres between samples of one fragment
constexpr float SEAM = 10.0f;                // texture coordinates a metre; more between samples is another island
constexpr float IRIS_ANGLE = 0.345f, IRIS_PLANE = 0.925f, SCLERA_ANGLE = 1.95f, REFRACTIVE_INDEX = 1.34f;

template <int CHANNELS> inline void sample(const Texture &t, float u, float v, float *out) {
    const float x = clamp(u * t.width - 0.5f, 0.0f, t.width - 1.001f);
    const float y = clamp((1 - v) * t.height - 0.5f, 0.0f, t.height - 1.001f);
    const int i = int(x), j = int(y);
    const float a = x - i, b = y - j;
    const float *p = t.data + (int64_t(j) * t.width + i) * CHANNELS, *q = p + int64_t(t.width) * CHANNELS;
    for (int k = 0; k < CHANNELS; ++k)
        out[k] = (p[k] * (1 - a) + p[k + CHANNELS] * a) * (1 - b) + (q[k] * (1 - a) + q[k + CHANNELS] * a) * b;
}

inline void sample_tiled(const Texture &t, float u, float v, float *out) {
    const float x = (u - std::floor(u)) * t.width, y = (1 - (v - std::floor(v))) * t.height;
    const int i = std::min(int(x), t.width - 1), j = std::min(int(y), t.height - 1);
    const int i1 = i + 1 == t.width ? 0 : i + 1, j1 = j + 1 == t.height ? 0 : j + 1;
    const float a = x - i, b = y - j;
    for (int k = 0; k < 2; ++k) {
        const float top = t.data[(j * t.width + i) * 2 + k] * (1 - a) + t.data[(j * t.width + i1) * 2 + k] * a;
        const float low = t.data[(j1 * t.width + i) * 2 + k] * (1 - a) + t.data[(j1 * t.width + i1) * 2 + k] * a;
        out[k] = top * (1 - b) + low * b;
    }
}

// Rows are the radius, columns the angle from -pi to pi, periodic.
inline Vec sample_polar(const Texture &t, float radius, float angle) {
    const float y = clamp(radius * t.height - 0.5f, 0.0f, t.height - 1.001f);
    float x = (angle / (2 * PI) + 0.5f) * t.width - 0.5f;
    if (x < 0) x += t.width;
    const int i = std::min(int(x), t.width - 1), j = int(y), i1 = i + 1 == t.width ? 0 : i + 1;
    const float a = x - i, b = y - j;
    const float *p = t.data + int64_t(j) * t.width * 3, *q = p + int64_t(t.width) * 3;
    return (load(p + 3 * i) * (1 - a) + load(p + 3 * i1) * a) * (1 - b) + (load(q + 3 * i) * (1 - a) + load(q + 3 * i1) * a) * b;
}

// Distance in millimetres to a polyline.
inline float distance_to(const float *line, int n, Vec p) {
    float best = 1e9f;
    for (int k = 0; k + 1 < n; ++k) {
        const Vec a = load(line + 3 * k), d = load(line + 3 * k + 3) - a, e = p - a;
        const float t = clamp(dot(e, d) / (dot(d, d) + 1e-12f), 0.0f, 1.0f);
        const Vec r = e - d * t;
        best = std::min(best, dot(r, r));
    }
    return 1000 * std::sqrt(best);
}

inline float noise(int x, int y) {           // interleaved gradient noise (Jimenez 2014)
    const float a = 0.06711056f * x + 0.00583715f * y, b = 52.9829189f * (a - std::floor(a));
    return b - std::floor(b);
}

struct Eye {
    Vec world_to_row[3];                     // rows of the camera's rotation
    Vec position;
    float fx, skew, cx, fy, cy;

    explicit Eye(const View &v) {
        const double *m = v.world_to_camera;
        for (int k = 0; k < 3; ++k) world_to_row[k] = {float(m[4 * k]), float(m[4 * k + 1]), float(m[4 * k + 2])};
        position = (world_to_row[0] * float(m[3]) + world_to_row[1] * float(m[7]) + world_to_row[2] * float(m[11])) * -1.0f;
        fx = float(v.fx), skew = float(v.skew), cx = float(v.cx), fy = float(v.fy), cy = float(v.cy);
    }
    // Direction through a pixel with depth 1 along the viewing axis.
    Vec ray(float x, float y) const {
        const float b = (y - cy) / fy, a = (x - cx - skew * b) / fx;
        return world_to_row[0] * a + world_to_row[1] * b + world_to_row[2];
    }
};

struct Taps {                                // a disc of samples on Vogel's spiral, turned a fragment
    float x[64], y[64];
    int n;
    Taps(int count, bool even_area) : n(std::min(count, 64)) {
        for (int k = 0; k < n; ++k) {
            const float t = (k + 0.5f) / n, radius = even_area ? std::sqrt(t) : t, angle = k * 2.399963f;
            x[k] = radius * std::cos(angle), y[k] = radius * std::sin(angle);
        }
    }
};

struct Circle {                              // points of the unit circle, to turn the taps by
    static constexpr int N = 1024;
    float cosine[N], sine[N];
    Circle() {
        for (int k = 0; k < N; ++k) cosine[k] = std::cos(2 * PI * k / N), sine[k] = std::sin(2 * PI * k / N);
    }
};

struct Lamp {                                // the shadow map's camera: pixels and depth of a point
    Vec x, y, z;
    float at[3], scale;
    int width, height;
    const float *map;

    Lamp(const View &v, const float *map) : width(v.width), height(v.height), map(map) {
        const double *m = v.world_to_camera;
        scale = float(v.fx);
        x = Vec{float(m[0]), float(m[1]), float(m[2])} * scale, at[0] = float(m[3] * v.fx + v.cx);
        y = Vec{float(m[4]), float(m[5]), float(m[6])} * float(v.fy), at[1] = float(m[7] * v.fy + v.cy);
        z = {float(m[8]), float(m[9]), float(m[10])}, at[2] = float(m[11]);
    }
};

struct Surface {                             // where a ray meets a face
    Vec position, normal;
    float weight[3];
    bool back;                               // seen from inside
};

inline Surface meet(const Mesh &mesh, const Eye &eye, int32_t face, Vec ray) {
    const int32_t *f = mesh.faces + 3 * face;
    const Vec a = load(mesh.vertices + 3 * f[0]) - eye.position, b = load(mesh.vertices + 3 * f[1]) - eye.position,
              c = load(mesh.vertices + 3 * f[2]) - eye.position;
    float w[3] = {dot(ray, cross(b, c)), dot(ray, cross(c, a)), dot(ray, cross(a, b))};
    Surface s;
    s.back = w[0] + w[1] + w[2] > 0;
    if (!s.back) w[0] = -w[0], w[1] = -w[1], w[2] = -w[2];
    float sum = 0;
    for (float &x : w) x = std::max(x, 0.0f), sum += x;
    for (int k = 0; k < 3; ++k) s.weight[k] = sum > 0 ? w[k] / sum : 1.0f / 3;
    s.position = eye.position + a * s.weight[0] + b * s.weight[1] + c * s.weight[2];
    s.normal = load(mesh.normals + 3 * f[0]) * s.weight[0] + load(mesh.normals + 3 * f[1]) * s.weight[1] +
               load(mesh.normals + 3 * f[2]) * s.weight[2];
    if (s.back) s.normal = s.normal * -1.0f;
    return s;
}

inline float vertex_value(const float *values, const int32_t *f, const float *w) {
    return values[f[0]] * w[0] + values[f[1]] * w[1] + values[f[2]] * w[2];
}

// Collect the fragments of one row of pixels.
int gather(const Mesh &mesh, const Part *parts, const Eye &eye, int samples, float seam, int width, int y, const int32_t *face,
           const float *depth, Fragments &r) {
    int n = 0;
    const int total = samples * samples, stride = samples * width;
    const float step = 1.0f / samples;
    for (int x = 0; x < width; ++x) {
        int32_t f[4];
        float z[4];
        bool any = false;
        for (int s = 0; s < total; ++s) {
            const int64_t at = int64_t(y * samples + s / samples) * stride + x * samples + s % samples;
            f[s] = face[at], z[s] = depth[at];
            any |= f[s] >= 0;
        }
        if (!any) continue;
        for (int s = 0; s < total; ++s) {
            if (f[s] < 0) continue;
            const int32_t first = f[s];
            const float near = z[s];
            const int part = mesh.part[first];
            int member[4], count = 0;
            bool one_face = true;
            const Vec facing = load(mesh.normals + 3 * mesh.faces[3 * first]);
            float mx = 0, my = 0;
            for (int t = s; t < total; ++t) {
                if (f[t] < 0 || mesh.part[f[t]] != part || std::abs(z[t] - near) > SAME_SURFACE) continue;
                // Closed lips and lids touch, but face each other.
                if (f[t] != first && dot(facing, load(mesh.normals + 3 * mesh.faces[3 * f[t]])) < 0.2f) continue;
                mx += (t % samples + 0.5f) * step, my += (t / samples + 0.5f) * step;
                one_face &= f[t] == first;
                member[count++] = t;
            }
            mx /= count, my /= count;
            Vec position{0, 0, 0}, normal{0, 0, 0}, color{0, 0, 0};
            float u = 0, v = 0, sky = 0, fade = 0, u0 = 0, v0 = 0;
            const int rays = one_face ? 1 : count;
            for (int k = 0; k < rays; ++k) {
                const int t = member[k];
                const int32_t *corner = mesh.faces + 3 * f[t];
                const Surface hit = one_face ? meet(mesh, eye, first, eye.ray(x + mx, y + my))
                                             : meet(mesh, eye, f[t], eye.ray(x + (t % samples + 0.5f) * step, y + (t / samples + 0.5f) * step));
                position = position + hit.position, normal = normal + hit.normal;
                const float *uv = mesh.corner_uv + 6 * int64_t(f[t]), *w = hit.weight;
                float a = uv[0] * w[0] + uv[2] * w[1] + uv[4] * w[2], b = uv[1] * w[0] + uv[3] * w[1] + uv[5] * w[2];
                if (k == 0) u0 = a, v0 = b;
                if (std::abs(a - u0) + std::abs(b - v0) > seam) a = u0, b = v0;      // another island
                u += a, v += b;
                sky += vertex_value(mesh.sky, corner, w) * (hit.back ? INSIDE : 1.0f), fade += vertex_value(mesh.fade, corner, w);
                if (mesh.colors)
                    color = color + load(mesh.colors + 3 * corner[0]) * w[0] + load(mesh.colors + 3 * corner[1]) * w[1] +
                            load(mesh.colors + 3 * corner[2]) * w[2];
            }
            const float share = 1.0f / rays;
            position = position * share;
            normal = unit(normal);
            const Vec view = unit(eye.position - position);
            r.pixel[n] = x, r.face[n] = first, r.part[n] = part;
            r.coverage[n] = float(count) / total * clamp(fade * share, 0.0f, 1.0f);
            r.depth[n] = near;
            r.set(r.position, n, position), r.set(r.normal, n, normal), r.set(r.view, n, view);
            r.set(r.bumped, n, normal), r.set(r.diffuse, n, normal), r.set(r.albedo, n, color * share);
            r.u[n] = u * share, r.v[n] = v * share, r.occlusion[n] = clamp(sky * share, 0.0f, 1.0f);
            r.roughness[n] = parts[part].roughness, r.specular[n] = parts[part].specular;
            r.cornea[n] = -1, r.lit[n] = 1;
            ++n;
            for (int k = 0; k < count; ++k) f[member[k]] = -1;
        }
    }
    return n;
}

void skin_material(const Mesh &mesh, const Part &part, Fragments &r, int i) {
    float texel[8], slope[4];
    const float u = r.u[i], v = r.v[i];
    sample<8>(part.texture, u, v, texel);
    sample<4>(part.slopes, u, v, slope);
    const float cavity = clamp(slope[2] / 3.0e-4f, 0.0f, 1.0f);
    r.albedo[0][i] = texel[0] * (1 - 0.22f * cavity);
    r.albedo[1][i] = texel[1] * (1 - 0.36f * cavity);
    r.albedo[2][i] = texel[2] * (1 - 0.38f * cavity);
    r.roughness[i] = texel[3], r.specular[i] = texel[4] * part.specular;
    r.lining[i] = texel[5], r.scatter[i] = texel[7];
    // Surface gradient of the height by u and v (Mikkelsen 2010, eq. 4, with dP/du and dP/dv of the face).
    const int64_t f = r.face[i];
    const int32_t *corner = mesh.faces + 3 * f;
    const float *uv = mesh.corner_uv + 6 * f;
    const Vec p = load(mesh.vertices + 3 * corner[0]);
    const Vec e1 = load(mesh.vertices + 3 * corner[1]) - p, e2 = load(mesh.vertices + 3 * corner[2]) - p;
    const float a1 = uv[2] - uv[0], b1 = uv[3] - uv[1], a2 = uv[4] - uv[0], b2 = uv[5] - uv[1];
    const float det = a1 * b2 - b1 * a2;
    if (std::abs(det) < 1e-12f) return;
    const Vec pu = (e1 * b2 - e2 * b1) * (1 / det), pv = (e2 * a1 - e1 * a2) * (1 / det), n = r.get(r.normal, i);
    const Vec across = cross(pv, n), along = cross(n, pu);
    const float volume = dot(pu, across);
    if (std::abs(volume) < 1e-9f) return;
    Vec gradient = (across * slope[0] + along * slope[1]) * (1 / volume);
    gradient = gradient * std::min(1.0f, 1.2f / std::max(length(gradient), 1e-9f));
    Vec bumped = unit(n - gradient), diffuse = unit(n - gradient * 0.75f);
    if (part.detail_gain > 0) {
        float micro[2];
        sample_tiled(part.detail, u * 22, v * 22, micro);
        const float gain = part.detail_gain * (0.35f + 0.65f * clamp(texel[6], 0.0f, 1.0f));
        const Vec d = unit(pu) * (micro[0] * gain) + unit(pv) * (micro[1] * gain);
        bumped = unit(bumped - d), diffuse = unit(diffuse - d * 0.6f);
    }
    r.set(r.bumped, i, bumped), r.set(r.diffuse, i, diffuse);
}

// Corneal refraction onto a flat iris; see look.eyes.EyeMaterial for the recipe.
void eye_material(const Part &part, Fragments &r, int i) {
    const float *m = part.rotation;
    const Vec axis[3] = {{m[0], m[3], m[6]}, {m[1], m[4], m[7]}, {m[2], m[5], m[8]}};
    const Vec e = (r.get(r.position, i) - load(part.center)) * (1 / part.radius), view = r.get(r.view, i);
    const Vec q{dot(e, axis[0]), dot(e, axis[1]), dot(e, axis[2])};
    const Vec v{dot(view, axis[0]), dot(view, axis[1]), dot(view, axis[2])};
    const Vec n = unit(q);
    const float theta = std::acos(clamp(n.z, -1.0f, 1.0f));
    const float cornea = 1 - smoothstep(0.92f, 1.12f, theta / IRIS_ANGLE);
    const Vec nc = unit(Vec{n.x * (1 + 0.75f * cornea), n.y * (1 + 0.75f * cornea), n.z});
    const float eta = 1 / REFRACTIVE_INDEX, c = dot(nc, v);
    const float k = std::sqrt(std::max(1 - eta * eta * (1 - c * c), 0.0f));
    const Vec d = v * -eta + nc * (eta * c - k);
    const float along = (IRIS_PLANE - q.z) / (std::abs(d.z) < 0.15f ? -0.15f : d.z);
    const Vec u = q + d * clamp(along, 0.0f, 0.3f);
    const float inverse = 1 / std::sin(IRIS_ANGLE);
    const Vec iris = sample_polar(part.iris, std::sqrt(u.x * u.x + u.y * u.y) * inverse, std::atan2(u.y, u.x));
    const Vec sclera = sample_polar(part.sclera, theta / SCLERA_ANGLE, std::atan2(n.y, n.x));
    const float white = smoothstep(0.90f, 1.10f, theta / IRIS_ANGLE);
    const Vec concave = unit(Vec{-0.75f * u.x * inverse, -0.75f * u.y * inverse, 1});
    const Vec soft = concave * (1 - white) + n * white;
    auto to_world = [&](Vec a) { return axis[0] * a.x + axis[1] * a.y + axis[2] * a.z; };
    r.set(r.albedo, i, iris * (1 - white) + sclera * white);
    r.set(r.bumped, i, to_world(nc)), r.set(r.diffuse, i, to_world(soft));
    r.cornea[i] = 1 - white;
    const Vec p = r.get(r.position, i);
    if (part.n_upper > 1) r.occlusion[i] *= 0.24f + 0.76f * smoothstep(-0.5f, 3.4f, distance_to(part.upper_lid, part.n_upper, p));
    if (part.n_lower > 1) r.occlusion[i] *= 0.65f + 0.35f * smoothstep(-0.2f, 1.6f, distance_to(part.lower_lid, part.n_lower, p));
}

void material(const Mesh &mesh, const Part &part, const Quality &quality, Fragments &r, int i) {
    r.lining[i] = 0, r.open[i] = 1, r.scatter[i] = part.scatter ? 1.0f : 0.0f;
    if (part.kind == SKIN) skin_material(mesh, part, r, i);
    if (part.kind == EYE) eye_material(part, r, i);
    if (part.kind == TEXTURED) {
        float texel[4];
        sample<4>(part.texture, r.u[i], r.v[i], texel);
        for (int k = 0; k < 3; ++k) r.albedo[k][i] = texel[k];
        r.roughness[i] = texel[3];
    }
    if (part.mouth_length > 0) {
        const float *p = quality.mouth_plane;
        const float behind = r.position[0][i] * p[0] + r.position[1][i] * p[1] + r.position[2][i] * p[2] + p[3];
        float light = clamp(part.mouth_start - behind / part.mouth_length, part.mouth_floor, 1.0f);
        if (part.mouth_power != 1) light = std::pow(light, part.mouth_power);
        if (part.kind == SKIN) light = 1 - r.lining[i] * (1 - light);
        r.occlusion[i] *= light;
        r.open[i] = light * light;           // lights without a shadow map do not shine into the mouth
    }
}

// Screen-space occlusion within 6 mm, for contact that the resting sky visibility does not know: (n,) in `open_share`.
void screen_occlusion(const Eye &eye, const Quality &q, const Taps &taps, int width, int height, const float *depth,
                      const Fragments &r, int n, int y, float *occlusion, float *weight, float *open_share) {
    constexpr float INVERSE = 1 / (0.006f * 0.006f);
    const int s = q.samples, columns = width * s, rows = height * s;
    const float reach = std::max(0.004f * q.pixels_per_metre, 1.0f) * s, least = 0.75f * s;
    const float py = (y + 0.5f) * s, back = 1.0f / s, inverse_fx = 1 / eye.fx, inverse_fy = 1 / eye.fy;
    const float *cosine = r.cosine, *sine = r.sine;
    const float *x0 = r.position[0], *y0 = r.position[1], *z0 = r.position[2], *nx = r.normal[0], *ny = r.normal[1], *nz = r.normal[2];
    const Vec right = eye.world_to_row[0], down = eye.world_to_row[1], ahead = eye.world_to_row[2];
    for (int i = 0; i < n; ++i) occlusion[i] = weight[i] = 0;
    for (int k = 0; k < taps.n; ++k) {
        const float stretch = reach + least / ((k + 0.5f) / taps.n), tx = taps.x[k] * stretch, ty = taps.y[k] * stretch;
#pragma omp simd
        for (int i = 0; i < n; ++i) {
            const int x = int((r.pixel[i] + 0.5f) * s + tx * cosine[i] - ty * sine[i]), v = int(py + tx * sine[i] + ty * cosine[i]);
            const bool inside = (x >= 0) & (v >= 0) & (x < columns) & (v < rows);
            const float z = std::min(depth[inside ? v * columns + x : 0], 1e6f);
            const float b = ((v + 0.5f) * back - eye.cy) * inverse_fy, a = ((x + 0.5f) * back - eye.cx - eye.skew * b) * inverse_fx;
            const float dx = eye.position.x + (right.x * a + down.x * b + ahead.x) * z - x0[i];
            const float dy = eye.position.y + (right.y * a + down.y * b + ahead.y) * z - y0[i];
            const float dz = eye.position.z + (right.z * a + down.z * b + ahead.z) * z - z0[i];
            const float square = dx * dx + dy * dy + dz * dz + 1e-18f, fall = std::max(0.0f, 1 - square * INVERSE);
            const float c = std::max(0.0f, (dx * nx[i] + dy * ny[i] + dz * nz[i]) / std::sqrt(square) - 0.12f);
            occlusion[i] += inside ? c * fall : 0.0f;
            weight[i] += inside ? 1.0f : 0.0f;
        }
    }
#pragma omp simd
    for (int i = 0; i < n; ++i) open_share[i] = std::max(0.0f, 1 - 2.1f * occlusion[i] / std::max(weight[i], 1.0f));
}

// Share of a disc in the shadow map that is not nearer to the light, of each fragment.
void shadow(const Lamp &lamp, const Quality &q, const Taps &taps, Fragments &r, int n, float *x, float *y, float *z) {
    constexpr float BIAS = 0.0012f;
    const float radius = q.shadow_radius * lamp.scale, share = 1.0f / taps.n;
    const float *cosine = r.cosine, *sine = r.sine;
    const float *x0 = r.position[0], *y0 = r.position[1], *z0 = r.position[2], *nx = r.normal[0], *ny = r.normal[1], *nz = r.normal[2];
    const float *map = lamp.map;
    const int width = lamp.width, height = lamp.height;
    float *lit = r.lit;
#pragma omp simd
    for (int i = 0; i < n; ++i) {
        const float px = x0[i] + nx[i] * BIAS, py = y0[i] + ny[i] * BIAS, pz = z0[i] + nz[i] * BIAS;
        x[i] = lamp.x.x * px + lamp.x.y * py + lamp.x.z * pz + lamp.at[0];
        y[i] = lamp.y.x * px + lamp.y.y * py + lamp.y.z * pz + lamp.at[1];
        z[i] = lamp.z.x * px + lamp.z.y * py + lamp.z.z * pz + lamp.at[2] - BIAS;
        lit[i] = 0;
    }
    for (int k = 0; k < taps.n; ++k) {
        const float tx = taps.x[k] * radius, ty = taps.y[k] * radius;
#pragma omp simd
        for (int i = 0; i < n; ++i) {
            const float u = x[i] + tx * cosine[i] - ty * sine[i], v = y[i] + tx * sine[i] + ty * cosine[i];
            const bool inside = (u >= 0) & (v >= 0) & (u < width) & (v < height);
            const float seen = map[inside ? int(v) * width + int(u) : 0];
            lit[i] += inside & (seen <= z[i]) ? 0.0f : share;
        }
    }
}

// One lobe of GGX over Smith's geometry term (Karis 2013, k = (roughness + 1)^2 / 8): what no light changes, then a light.
struct Lobe {
    simd::Floats scale, width, k, rest;
    Lobe(simd::Floats roughness, simd::Floats nv, float share) {
        using simd::broadcast;
        const simd::Floats square = roughness * roughness, a2 = square * square, wide = roughness + broadcast(1.0f);
        k = wide * wide * broadcast(0.125f), rest = broadcast(1.0f) - k, width = a2 - broadcast(1.0f);
        scale = a2 * broadcast(share / PI) / (nv * rest + k);
    }
    simd::Floats of(simd::Floats square_nh, simd::Floats nl) const {
        const simd::Floats t = square_nh * width + simd::broadcast(1.0f);
        return scale / (t * t * (nl * rest + k));
    }
};

// Wrapped diffuse and one or two GGX lobes of every light and the sky's reflection, over all fragments of the row.
template <int LOBES> void lights(const Lighting &lighting, const Part *parts, Fragments &r, int n) {
    using simd::broadcast, simd::Floats, simd::maximum, simd::minimum;
    const Floats one = broadcast(1.0f), zero = simd::zeros(), half = broadcast(0.5f);
    for (int i = 0; i < n; i += simd::LANES) {
        const auto at = [&](const float *field) { return simd::load(field + i); };
        const Floats ao = at(r.occlusion), open = at(r.open), roughness = at(r.roughness), specular = at(r.specular);
        const Floats dx = at(r.diffuse[0]), dy = at(r.diffuse[1]), dz = at(r.diffuse[2]);
        const Floats bx = at(r.bumped[0]), by = at(r.bumped[1]), bz = at(r.bumped[2]);
        const Floats vx = at(r.view[0]), vy = at(r.view[1]), vz = at(r.view[2]);
        const Floats facing = bx * vx + by * vy + bz * vz, nv = maximum(facing, broadcast(0.05f));
        const Lobe first(roughness, nv, LOBES > 1 ? 0.7f : 1.0f);
        const Lobe second(maximum(broadcast(0.08f), roughness * broadcast(0.62f)), nv, 0.3f);
        Floats wrap[3], softer[3], diffuse[3], shine[3] = {zero, zero, zero};
        const Floats up = dy * half + half, root = simd::square_root(ao);
        const Floats share[3] = {root * (broadcast(0.45f) + broadcast(0.55f) * root), ao, ao};
        for (int k = 0; k < 3; ++k) {
            wrap[k] = at(r.wrap[k]), softer[k] = one / (one + wrap[k]);
            diffuse[k] = (broadcast(lighting.ground[k]) + broadcast(lighting.sky[k] - lighting.ground[k]) * up) * share[k];
        }
        const Floats reach = minimum(one, broadcast(0.4f) + broadcast(0.6f) * ao) * broadcast(1.35f / PI);
        const Floats gloss = specular * ao * broadcast(0.25f);
        for (int j = 0; j < lighting.n; ++j) {
            const Floats lx = broadcast(lighting.direction[j][0]), ly = broadcast(lighting.direction[j][1]), lz = broadcast(lighting.direction[j][2]);
            const Floats lit = j == lighting.shadowed ? at(r.lit) : open;
            const Floats nd = dx * lx + dy * ly + dz * lz, bl = bx * lx + by * ly + bz * lz, vl = vx * lx + vy * ly + vz * lz;
            // The half vector of unit vectors v and l has the length sqrt(2 + 2 v . l).
            const Floats inverse = one / simd::square_root(maximum(broadcast(2.0f) + (vl + vl), broadcast(1e-6f)));
            const Floats nl = maximum(bl, zero), nh = minimum(one, maximum((bl + facing) * inverse, zero));
            const Floats g = one - maximum((one + vl) * inverse, zero), g2 = g * g;
            const Floats fresnel = broadcast(SPECULAR_NORMAL) + broadcast(1 - SPECULAR_NORMAL) * g2 * g2 * g;
            Floats lobes = first.of(nh * nh, nl);
            if (LOBES > 1) lobes += second.of(nh * nh, nl);
            const Floats strength = gloss * lit * lobes * fresnel * nl, amount = lit * reach;
            for (int k = 0; k < 3; ++k) {
                const Floats color = broadcast(lighting.color[j][k]);
                diffuse[k] += color * amount * maximum((nd + wrap[k]) * softer[k], zero);
                shine[k] += color * strength;
            }
        }
        // Reflection of the sky: a horizon gradient.
        const Floats edge = one - minimum(one, maximum(facing, zero)), rough = one - roughness, edge2 = edge * edge;
        const Floats mirror = by * (facing + facing) - vy, s = minimum(one, maximum(mirror * half + half, zero));
        const Floats fresnel = broadcast(SPECULAR_NORMAL) + half * rough * rough * edge2 * edge2 * edge;
        const Floats amount = (broadcast(0.10f) + broadcast(0.55f) * s * s) * fresnel * specular * ao * (broadcast(0.35f) + broadcast(0.3f) * rough);
        const float tint[3] = {0.9f, 1.0f, 1.1f};
        for (int k = 0; k < 3; ++k) {
            simd::store(r.irradiance[k] + i, diffuse[k]);
            simd::store(r.reflection[k] + i, shine[k] + broadcast(tint[k]) * amount);
        }
    }
    // Eyes see one soft box instead.
    const Vec box = load(lighting.catch_light), side = unit(cross(box, Vec{0, 1, 0})), top = cross(side, box);
    for (int i = 0; i < n; ++i) {
        if (parts[r.part[i]].kind != EYE) continue;
        const Vec b = r.get(r.bumped, i), v = r.get(r.view, i), mirror = b * (2 * dot(b, v)) - v;
        const float inside = dot(mirror, box) > 0 ? smoothstep(0.20f, 0.16f, std::abs(dot(mirror, side))) * smoothstep(0.26f, 0.22f, std::abs(dot(mirror, top))) : 0.0f;
        const float glint = 1.15f * inside * r.cornea[i] * clamp(r.occlusion[i] * 1.3f - 0.2f, 0.0f, 1.0f);
        for (int k = 0; k < 3; ++k) r.reflection[k][i] = r.reflection[k][i] * 0.25f + glint;
    }
}

}  // namespace

// face, depth: (samples height, samples width) visibility; map: the shadow map of `light`, or null; planes: PLANES x
// height x width; near: (height, width) depth of the scattering surface. Row by row, so threads do not matter.
void shade(const Mesh &mesh, const Part *parts, const View &view, const Lighting &lighting, const Quality &quality,
           const int32_t *face, const float *depth, const View &light, const float *map, float *planes, float *near,
           int threads) {
    const int width = view.width, height = view.height;
    const int64_t area = int64_t(width) * height;
    const Eye eye(view);
    const Lamp lamp(light, map);
    const Taps shadow_taps(quality.shadow_taps, true), occlusion_taps(quality.occlusion_taps, false);
    static const Circle circle;
#pragma omp parallel num_threads(threads)
    {
        Fragments r(width * quality.samples * quality.samples);
#pragma omp for schedule(dynamic, 4)
        for (int y = 0; y < height; ++y) {
            const int64_t row = int64_t(y) * width;
            for (int plane = 0; plane < PLANES; ++plane) std::fill(planes + plane * area + row, planes + plane * area + row + width, 0.0f);
            std::fill(near + row, near + row + width, 1e6f);
            const int n = gather(mesh, parts, eye, quality.samples, SEAM / quality.pixels_per_metre, width, y, face, depth, r);
            for (int i = 0; i < n; ++i) {
                const Part &part = parts[r.part[i]];
                material(mesh, part, quality, r, i);
                const float wrap[3] = {part.kind == SKIN ? 0.20f : 0.05f, part.kind == SKIN ? 0.08f : 0.05f, 0.05f};
                for (int k = 0; k < 3; ++k) r.wrap[k][i] = wrap[k];
                const int turn = int(noise(r.pixel[i], y) * Circle::N) & (Circle::N - 1);
                r.cosine[i] = circle.cosine[turn], r.sine[i] = circle.sine[turn];
            }
            // The light's fields are not needed yet: they serve as scratch.
            if (quality.occlusion_taps > 0) {
                screen_occlusion(eye, quality, occlusion_taps, width, height, depth, r, n, y, r.reflection[0], r.reflection[1], r.reflection[2]);
                for (int i = 0; i < n; ++i)
                    if (parts[r.part[i]].kind != EYE) r.occlusion[i] *= 0.5f + 0.5f * r.reflection[2][i];
            }
            if (map) shadow(lamp, quality, shadow_taps, r, n, r.reflection[0], r.reflection[1], r.reflection[2]);
            if (quality.lobes > 1)
                lights<2>(lighting, parts, r, n);
            else
                lights<1>(lighting, parts, r, n);
            for (int i = 0; i < n; ++i) {
                const int64_t at = row + r.pixel[i];
                const float c = r.coverage[i];
                planes[OPACITY * area + at] += c;
                // What is scattered is blurred later; the rest of the light is final here.
                const bool scatter = quality.scatter && parts[r.part[i]].scatter;
                const float blurred = scatter ? clamp(r.scatter[i], 0.0f, 1.0f) : 0.0f;
                if (scatter) planes[SCATTER * area + at] += c, near[at] = std::min(near[at], r.depth[i]);
                for (int k = 0; k < 3; ++k) {
                    const float shine = std::min(r.reflection[k][i], 8.0f), light = r.irradiance[k][i];
                    planes[(ALBEDO + k) * area + at] += c * r.albedo[k][i] * blurred;
                    if (scatter) planes[(IRRADIANCE + k) * area + at] += c * light;
                    planes[(LIGHT + k) * area + at] += c * (r.albedo[k][i] * light * (1 - blurred) + shine);
                }
            }
        }
    }
}

}  // namespace MESHANIM_NAMESPACE
