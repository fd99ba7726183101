// The derivative of projection: sums an item's slots and carries them to the parameters, LANES Gaussians at a time
// and image after image, so that what images share is summed in one order.
#include <cstring>

#include "harmonics.h"
#include "isa.h"
#include "projection.h"
#include "splat.h"

namespace MESHANIM_NAMESPACE {
namespace {

using splat::MOMENTS;
using splat::ParameterGradients;
using splat::Scene;

// Gradients of LANES items: what their slots hold, summed.
struct Sums {
    Floats moments[MOMENTS], color[splat::GROUP], depth;   // color: of harmonics, or of all channels of a single group
};

class ChunkGradient {
   public:
    ChunkGradient(const Scene &scene, const ParameterGradients &out, int64_t chunk)
        : scene_(scene), out_(out), chunk_(chunk), begin_(chunk * splat::CHUNK),
          end_(begin_ + splat::CHUNK < scene.gaussians ? begin_ + splat::CHUNK : scene.gaussians),
          direct_(scene.coefficients == 0 && out.n_groups == 1 && (scene.channels == 1 || scene.channels == 3 || scene.channels == 4)) {}

    void run() {
        if (!direct_) clear(out_.colors, scene_.colors, color_width());
        for (int64_t image = 0; image < scene_.images(); ++image) {
            const View view(scene_, image);
            for (int j = 0; j < 12; ++j) pose_[j] = broadcast(0.0f), total_[j] = 0;
            for (int64_t first = begin_; first < end_; first += LANES) items(view, image, first);
            if (!out_.poses) continue;
            for (int j = 0; j < 12; ++j) out_.poses[(image * scene_.chunks() + chunk_) * 12 + j] = total_[j];
        }
    }

   private:
    int64_t color_width() const { return scene_.coefficients ? 3 * scene_.coefficients : scene_.channels; }

    void clear(float *data, const splat::Field &field, int64_t width) {
        if (!data) return;
        const int64_t rows = field.frame ? scene_.frames : 1;
        for (int64_t row = 0; row < rows; ++row)
            std::memset(data + row * field.frame + begin_ * width, 0, sizeof(float) * size_t((end_ - begin_) * width));
    }

    // Numbers of a slot that a vector of it holds.
    static int rest(int width, int part) {
        const int left = width - part * LANES;
        return left < 0 ? 0 : left < LANES ? left : LANES;
    }

    // Returns which lanes have slots. Gradients of plain colours in several groups are done with here.
    uint32_t gather(int64_t image, int64_t first, int count, Sums &sums) {
        constexpr int PARTS = (MOMENTS + splat::GROUP + LANES - 1) / LANES;
        const int64_t frame = image / scene_.cameras;
        const int32_t *slots = out_.slots + image * scene_.gaussians + first;
        uint32_t seen = 0;
        for (int l = 0; l < count; ++l) seen |= uint32_t(slots[l] != slots[l + 1]) << l;
        for (Floats &moment : sums.moments) moment = broadcast(0.0f);
        for (Floats &color : sums.color) color = broadcast(0.0f);
        sums.depth = broadcast(0.0f);
        if (!seen) return 0;
        for (int group = 0; group < out_.n_groups; ++group) {
            const int channels = out_.channels[group], width = MOMENTS + channels;
            Floats rows[PARTS][LANES], fields[PARTS * LANES];
            for (int l = 0; l < LANES; ++l) {
                Floats sum[PARTS];
                for (Floats &part : sum) part = broadcast(0.0f);
                if (l < count) {
                    const float *slot = out_.groups[group] + int64_t(slots[l]) * width;
                    for (int32_t i = slots[l]; i < slots[l + 1]; ++i, slot += width)
                        for (int part = 0; part < PARTS; ++part) sum[part] += simd::load_first(slot + part * LANES, rest(width, part));
                }
                for (int part = 0; part < PARTS; ++part) rows[part][l] = sum[part];
            }
            for (int part = 0; part < PARTS; ++part) {
                simd::transpose(rows[part]);
                for (int j = 0; j < LANES; ++j) fields[part * LANES + j] = rows[part][j];
            }
            for (int j = 0; j < MOMENTS; ++j) sums.moments[j] += fields[j];
            const int64_t channel = int64_t(group) * splat::GROUP;
            const int colors = scene_.channels - channel < channels ? int(scene_.channels - channel) : channels;
            if (colors < channels) sums.depth = fields[MOMENTS + colors];
            if (scene_.coefficients || direct_)
                for (int j = 0; j < colors; ++j) sums.color[j] = fields[MOMENTS + j];
            else if (out_.colors)
                add(out_.colors + frame * scene_.colors.frame + first * scene_.channels + channel, fields + MOMENTS, colors, scene_.channels, seen, count);
        }
        return seen;
    }

    void items(const View &view, int64_t image, int64_t first) {
        const int count = int(end_ - first < LANES ? end_ - first : LANES);
        const int64_t frame = image / scene_.cameras, base = image * scene_.gaussians + first;
        Sums sums;
        const uint32_t seen = gather(image, first, count, sums);
        if (out_.offsets) std::memset(out_.offsets + 2 * base, 0, 2 * sizeof(float) * size_t(count));
        if (!seen) return nothing(image, first, count);
        float lit[LANES];
        for (int l = 0; l < LANES; ++l) lit[l] = seen >> l & 1 ? 1.0f : 0.0f;
        const simd::Mask visible = simd::greater(simd::load(lit), broadcast(0.5f));
        const Inputs in = load_inputs(scene_, frame, first, count);
        const Ellipse e(view, scene_, in);
        const Floats zero = broadcast(0.0f), eps = broadcast(scene_.eps2d);
        const Floats *g = sums.moments;   // sums of d L / d ln alpha times 1, p, q, p^2, p q, q^2

        // d ln alpha / d (p, q) = -(p, q) / KAPPA; p = A dx + B dy with dx = pixel - position.
        const Floats inverse_kappa = broadcast(1 / KAPPA);
        Floats position[2] = {inverse_kappa * e.a * g[1], inverse_kappa * fma(e.b, g[1], e.c * g[2])};
        if (out_.offsets) add(out_.offsets + 2 * base, position, 2, 2, seen, count);

        // Rows of L M, L = (A B; 0 C) whitening: again by Lagrange, without cancellation.
        // (m1.m1 + eps) m0 - (m0.m1) m1 = eps m0 + m1 x (m0 x m1), and the Gaussian's scale is a factor of each column.
        Floats white[2][3], whole[2][3];
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            const Floats turned = in.scale[k] * e.spread[1][k] * e.wedge[l] - in.scale[l] * e.spread[1][l] * e.wedge[k];
            white[0][j] = e.a / e.yy * fma(eps, e.axes[0][j], turned);
            white[1][j] = e.c * e.axes[1][j];
            whole[0][j] = white[0][j] * in.scale[j], whole[1][j] = white[1][j] * in.scale[j];
        }
        // d L / d M = L' G (L M) / KAPPA^2, G the second moments.
        const Floats strength = inverse_kappa * inverse_kappa;
        Floats inner[2][3], spread[2][3], scale[3];
        for (int j = 0; j < 3; ++j) {
            inner[0][j] = strength * fma(g[3], whole[0][j], g[4] * whole[1][j]);
            inner[1][j] = strength * fma(g[4], whole[0][j], g[5] * whole[1][j]);
            scale[j] = fma(inner[0][j], white[0][j], inner[1][j] * white[1][j]);
            spread[0][j] = e.a * inner[0][j];
            spread[1][j] = fma(e.b, inner[0][j], e.c * inner[1][j]);
        }
        Floats opacity = g[0] / in.opacity;
        if (scene_.antialiased) compensate(e, in, g[0], spread, scale);

        // M = axes * scale, axes = row * turn.
        Floats axes[2][3], row[2][3], turn[3][3];
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 3; ++j) axes[i][j] = spread[i][j] * in.scale[j];
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 3; ++j) row[i][j] = dot(axes[i], e.turn[j]);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) turn[i][j] = fma(e.row[0][i], axes[0][j], e.row[1][i] * axes[1][j]);
        Floats quaternion[4];
        turn_backward(e, turn, quaternion);

        // row = focal / z (R_i - slope_i R_z); position = focal ratio + centre.
        const float *r = view.rotation;
        const Floats focal[2] = {broadcast(view.fx), broadcast(view.fy)};
        Floats camera[3], inverse_z = zero, depth = sums.depth;
        for (int i = 0; i < 2; ++i) {
            const float low = i ? view.low_y : view.low_x, high = i ? view.high_y : view.high_x;
            const simd::Mask free = simd::both(simd::at_least(e.ratio[i], broadcast(low)), simd::at_least(broadcast(high), e.ratio[i]));
            const Floats along = fma(row[i][0], broadcast(r[6]), fma(row[i][1], broadcast(r[7]), row[i][2] * broadcast(r[8])));
            const Floats ratio = fma(focal[i], position[i], simd::keep(free, zero - focal[i] * e.inverse_z * along));
            inverse_z = fma(focal[i], dot(row[i], e.direction[i]), fma(ratio, e.camera[i], inverse_z));
            camera[i] = ratio * e.inverse_z;
        }
        camera[2] = depth - e.inverse_z * e.inverse_z * inverse_z;
        Floats mean[3];
        for (int j = 0; j < 3; ++j) mean[j] = fma(broadcast(r[j]), camera[0], fma(broadcast(r[3 + j]), camera[1], broadcast(r[6 + j]) * camera[2]));
        Floats direction[3] = {zero, zero, zero};
        if (scene_.coefficients) {
            harmonics_gradient(view, in, sums, frame, first, count, seen, direction);
            for (int j = 0; j < 3; ++j) mean[j] += direction[j];
        }
        if (out_.poses) pose(view, e, in, row, camera, direction, visible);
        write(out_.means, scene_.means, mean, image, first, visible, count);
        write(out_.quaternions, scene_.quaternions, quaternion, image, first, visible, count);
        write(out_.scales, scene_.scales, scale, image, first, visible, count);
        const Floats opacities[1] = {opacity};
        write(out_.opacities, scene_.opacities, opacities, image, first, visible, count);
        if (!direct_) return;
        const Floats colors[3] = {sums.color[0], sums.color[1], sums.color[2]}, gray[1] = {colors[0]};
        if (scene_.channels == 1) write(out_.colors, scene_.colors, gray, image, first, visible, count);
        else if (scene_.channels == 3) write(out_.colors, scene_.colors, colors, image, first, visible, count);
        else write(out_.colors, scene_.colors, sums.color, image, first, visible, count);
    }

    // compensation^2 = sharp / determinant.
    void compensate(const Ellipse &e, const Inputs &in, Floats strength, Floats (&spread)[2][3], Floats (&scale)[3]) {
        const Floats eps = broadcast(scene_.eps2d);
        // d ln compensation = d sharp / (2 sharp) - d determinant / (2 determinant); with S the sharp covariance,
        // d det(S) / d M = 2 adj(S) M, and adj(S + eps) = adj(S) + eps.
        const Floats rest = (broadcast(1.0f) / e.sharp - broadcast(1.0f) / e.determinant) * strength, blur = strength * eps / e.determinant;
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            // Rows of adj(S) axes: m1 x (m0 x m1) and (m0 x m1) x m0, less the scale of column j.
            const Floats first = in.scale[k] * e.spread[1][k] * e.wedge[l] - in.scale[l] * e.spread[1][l] * e.wedge[k];
            const Floats second = in.scale[l] * e.spread[0][l] * e.wedge[k] - in.scale[k] * e.spread[0][k] * e.wedge[l];
            const Floats a = fma(rest, first, broadcast(0.0f) - blur * e.axes[0][j]), b = fma(rest, second, broadcast(0.0f) - blur * e.axes[1][j]);
            spread[0][j] = fma(a, in.scale[j], spread[0][j]);
            spread[1][j] = fma(b, in.scale[j], spread[1][j]);
            scale[j] = fma(in.scale[j], fma(a, e.axes[0][j], b * e.axes[1][j]), scale[j]);
        }
    }

    static void turn_backward(const Ellipse &e, const Floats (&t)[3][3], Floats (&out)[4]) {
        const Floats w = e.unit[0], x = e.unit[1], y = e.unit[2], z = e.unit[3], two = broadcast(2.0f);
        const Floats a = t[2][1] - t[1][2], b = t[0][2] - t[2][0], c = t[1][0] - t[0][1];
        const Floats d = t[0][1] + t[1][0], f = t[0][2] + t[2][0], h = t[1][2] + t[2][1];
        const Floats q[4] = {two * (x * a + y * b + z * c),
                             two * (w * a + y * d + z * f - two * x * (t[1][1] + t[2][2])),
                             two * (w * b + x * d + z * h - two * y * (t[0][0] + t[2][2])),
                             two * (w * c + x * f + y * h - two * z * (t[0][0] + t[1][1]))};
        const Floats along = w * q[0] + x * q[1] + y * q[2] + z * q[3];
        for (int j = 0; j < 4; ++j) out[j] = (q[j] - e.unit[j] * along) * e.inverse_length;
    }

    void harmonics_gradient(const View &view, const Inputs &in, const Sums &sums, int64_t frame, int64_t first, int count,
                            uint32_t seen, Floats (&direction)[3]) {
        Floats d[3], basis[16], change[16], unit[3];
        for (int j = 0; j < 3; ++j) d[j] = in.mean[j] - broadcast(view.position[j]);
        const Floats inverse = broadcast(1.0f) / simd::square_root(dot(d, d));
        for (int j = 0; j < 3; ++j) unit[j] = d[j] * inverse;
        harmonics(scene_.coefficients, unit[0], unit[1], unit[2], basis);
        float values[16][LANES], changes[16][LANES] = {}, gradients[3][LANES];
        for (int k = 0; k < scene_.coefficients; ++k) simd::store(values[k], basis[k]);
        for (int j = 0; j < 3; ++j) simd::store(gradients[j], sums.color[j]);
        const int64_t width = 3 * scene_.coefficients;
        const float *rows = at(scene_.colors, frame, first, width);
        for (int l = 0; l < count; ++l) {
            if (!(seen >> l & 1)) continue;
            const float *row = rows + l * width;
            float *out = out_.colors ? out_.colors + frame * scene_.colors.frame + (first + l) * width : nullptr;
            for (int j = 0; j < 3; ++j) {
                float color = 0.5f;
                for (int k = 0; k < scene_.coefficients; ++k) color += values[k][l] * row[3 * k + j];
                const float gradient = color > 0 ? gradients[j][l] : 0.0f;   // clamped at zero
                for (int k = 0; k < scene_.coefficients; ++k) {
                    changes[k][l] += gradient * row[3 * k + j];
                    if (out) out[3 * k + j] += gradient * values[k][l];
                }
            }
        }
        for (int k = 0; k < scene_.coefficients; ++k) change[k] = simd::load(changes[k]);
        Floats g[3];
        harmonics_backward(scene_.coefficients, unit[0], unit[1], unit[2], change, g[0], g[1], g[2]);
        const Floats along = dot(unit, g);
        for (int j = 0; j < 3; ++j) direction[j] = (g[j] - unit[j] * along) * inverse;
    }

    void pose(const View &view, const Ellipse &e, const Inputs &in, const Floats (&row)[2][3], const Floats (&camera)[3],
              const Floats (&direction)[3], simd::Mask visible) {
        // camera = R mean + t; row_i = focal / z (R_i - slope_i R_z); the viewer stands at -R' t.
        const float *r = view.rotation, *t = view.translation;
        const Floats focal[2] = {broadcast(view.fx) * e.inverse_z, broadcast(view.fy) * e.inverse_z};
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                Floats gradient = fma(camera[i], in.mean[j], broadcast(t[i]) * direction[j]);
                if (i < 2) gradient = fma(focal[i], row[i][j], gradient);
                else gradient -= focal[0] * e.slope[0] * row[0][j] + focal[1] * e.slope[1] * row[1][j];
                pose_[4 * i + j] = gradient;
            }
        for (int i = 0; i < 3; ++i)
            pose_[4 * i + 3] = camera[i] + fma(broadcast(r[3 * i]), direction[0], fma(broadcast(r[3 * i + 1]), direction[1], broadcast(r[3 * i + 2]) * direction[2]));
        for (int j = 0; j < 12; ++j) total_[j] += simd::sum(simd::keep(visible, pose_[j]));
    }

    // Columns added to the rows of the lanes that are seen, `stride` floats apart.
    static void add(float *rows, const Floats *columns, int width, int64_t stride, uint32_t seen, int count) {
        float values[4][LANES];
        for (int j = 0; j < width; ++j) simd::store(values[j], columns[j]);
        for (int l = 0; l < count; ++l)
            if (seen >> l & 1)
                for (int j = 0; j < width; ++j) rows[l * stride + j] += values[j][l];
    }

    // Whether this image is the first to write to its rows of a field; the others add.
    bool fresh(const splat::Field &field, int64_t image) const { return field.frame ? image % scene_.cameras == 0 : image == 0; }

    template <int WIDTH>
    void write(float *data, const splat::Field &field, const Floats (&columns)[WIDTH], int64_t image, int64_t first, simd::Mask visible, int count) {
        if (!data) return;
        float *const rows = data + image / scene_.cameras * field.frame + first * WIDTH;
        Floats sums[WIDTH];
        if (fresh(field, image)) for (Floats &sum : sums) sum = broadcast(0.0f);
        else load_columns(rows, count, sums);
        for (int j = 0; j < WIDTH; ++j) sums[j] += simd::keep(visible, columns[j]);
        if (count == LANES) return simd::store_columns(rows, sums);
        float whole[WIDTH * LANES];
        simd::store_columns(whole, sums);
        std::memcpy(rows, whole, sizeof(float) * size_t(WIDTH * count));
    }

    // No item is seen: zeros where nothing has been written.
    void nothing(int64_t image, int64_t first, int count) {
        auto zero = [&](float *data, const splat::Field &field, int64_t width) {
            if (data && fresh(field, image))
                std::memset(data + image / scene_.cameras * field.frame + first * width, 0, sizeof(float) * size_t(width * count));
        };
        zero(out_.means, scene_.means, 3);
        zero(out_.quaternions, scene_.quaternions, 4);
        zero(out_.scales, scene_.scales, 3);
        zero(out_.opacities, scene_.opacities, 1);
        if (direct_) zero(out_.colors, scene_.colors, scene_.channels);
    }

    const Scene &scene_;
    const ParameterGradients &out_;
    int64_t chunk_, begin_, end_;
    bool direct_;   // gradients of colours are written like the others
    Floats pose_[12];
    double total_[12];
};

}  // namespace

void splat_project_backward(const Scene &scene, const team::Member &member, const ParameterGradients &out) {
    team::each(member, scene.chunks(), [&](int64_t chunk) { ChunkGradient(scene, out, chunk).run(); });
}

}  // namespace MESHANIM_NAMESPACE
