// EWA projection of LANES Gaussians at once, with all that its derivative needs again.
#pragma once

#include "../simd.h"
#include "splat.h"

namespace MESHANIM_NAMESPACE {
namespace {

using simd::Floats;
using simd::LANES;
using simd::broadcast;
using simd::fma;

constexpr float KAPPA = 0.72134752044448170f;      // log2(e) / 2: sigma = (p^2 + q^2) / (2 KAPPA)
constexpr float GUARD = 0.15f;                     // how far beyond the image the perspective's slope still follows

struct View {
    float rotation[9], translation[3];
    float fx, fy, cx, cy;
    float low_x, high_x, low_y, high_y;
    float position[3];

    View(const splat::Scene &scene, int64_t image) {
        const float *m = scene.poses + 16 * image, *k = scene.intrinsics + 9 * image;
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) rotation[3 * i + j] = m[4 * i + j];
            translation[i] = m[4 * i + 3];
        }
        fx = k[0], cx = k[2], fy = k[4], cy = k[5];
        const float w = float(scene.width), h = float(scene.height);
        low_x = -(cx + GUARD * w) / fx, high_x = (w - cx + GUARD * w) / fx;
        low_y = -(cy + GUARD * h) / fy, high_y = (h - cy + GUARD * h) / fy;
        for (int j = 0; j < 3; ++j)
            position[j] = -(rotation[j] * translation[0] + rotation[3 + j] * translation[1] + rotation[6 + j] * translation[2]);
    }
};

// LANES Gaussians' fields, each component a vector.
struct Inputs {
    Floats mean[3], quaternion[4], scale[3], opacity;
};

template <int WIDTH>
inline void load_columns(const float *rows, int count, Floats (&out)[WIDTH]) {
    if (count == LANES) return simd::load_columns(rows, out);
    float columns[WIDTH][LANES];
    for (int l = 0; l < LANES; ++l) {
        const float *row = rows + WIDTH * (l < count ? l : count - 1);
        for (int j = 0; j < WIDTH; ++j) columns[j][l] = row[j];
    }
    for (int j = 0; j < WIDTH; ++j) out[j] = simd::load(columns[j]);
}

inline const float *at(const splat::Field &field, int64_t frame, int64_t gaussian, int64_t width) {
    return field.data + frame * field.frame + gaussian * width;
}

inline Inputs load_inputs(const splat::Scene &scene, int64_t frame, int64_t first, int count) {
    Inputs in;
    load_columns<3>(at(scene.means, frame, first, 3), count, in.mean);
    load_columns<4>(at(scene.quaternions, frame, first, 4), count, in.quaternion);
    load_columns<3>(at(scene.scales, frame, first, 3), count, in.scale);
    Floats opacity[1];
    load_columns<1>(at(scene.opacities, frame, first, 1), count, opacity);
    in.opacity = opacity[0];
    return in;
}

inline Floats dot(const Floats *a, const Floats *b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }

struct Ellipse {
    Floats camera[3];                   // the centre in camera space
    Floats inverse_z, ratio[2], slope[2];
    Floats unit[4], inverse_length;     // quaternion, and one over its length
    Floats turn[3][3];                  // the Gaussian's axes as columns
    Floats direction[2][3], row[2][3];  // rows of the Jacobian times the camera's rotation, without and with focal / z
    Floats axes[2][3];                  // row * turn: the unit axes in the image
    Floats spread[2][3];                // axes times scales: covariance = spread spread'
    Floats wedge[3];                    // axes[0] x axes[1]
    Floats position[2];
    Floats sharp, xx, xy, yy, determinant;   // covariance after eps2d; `sharp` is its determinant before
    Floats a, b, c;                     // the whitened form
    Floats compensation, opacity;

    Ellipse(const View &view, const splat::Scene &scene, const Inputs &in) {
        const float *r = view.rotation;
        for (int i = 0; i < 3; ++i)
            camera[i] = fma(broadcast(r[3 * i]), in.mean[0], fma(broadcast(r[3 * i + 1]), in.mean[1],
                        fma(broadcast(r[3 * i + 2]), in.mean[2], broadcast(view.translation[i]))));
        inverse_z = broadcast(1.0f) / camera[2];
        ratio[0] = camera[0] * inverse_z, ratio[1] = camera[1] * inverse_z;
        slope[0] = simd::minimum(simd::maximum(ratio[0], broadcast(view.low_x)), broadcast(view.high_x));
        slope[1] = simd::minimum(simd::maximum(ratio[1], broadcast(view.low_y)), broadcast(view.high_y));
        normalise(in.quaternion);
        turn_by_quaternion();
        const Floats focal[2] = {broadcast(view.fx) * inverse_z, broadcast(view.fy) * inverse_z};
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 3; ++j) {
                direction[i][j] = broadcast(r[3 * i + j]) - slope[i] * broadcast(r[6 + j]);
                row[i][j] = focal[i] * direction[i][j];
            }
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 3; ++j) {
                axes[i][j] = fma(row[i][0], turn[0][j], fma(row[i][1], turn[1][j], row[i][2] * turn[2][j]));
                spread[i][j] = axes[i][j] * in.scale[j];
            }
        position[0] = fma(broadcast(view.fx), ratio[0], broadcast(view.cx));
        position[1] = fma(broadcast(view.fy), ratio[1], broadcast(view.cy));
        // Lagrange: det(M M') = |m0 x m1|^2, with the scales taken out of the cross product, so that nothing
        // cancels for needles and the determinant with eps2d is a sum of positive terms.
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            wedge[j] = axes[0][k] * axes[1][l] - axes[0][l] * axes[1][k];
        }
        sharp = broadcast(0.0f);
        for (int j = 0; j < 3; ++j) {
            const Floats side = wedge[j] * in.scale[(j + 1) % 3] * in.scale[(j + 2) % 3];
            sharp = fma(side, side, sharp);
        }
        const Floats eps = broadcast(scene.eps2d), x = dot(spread[0], spread[0]), y = dot(spread[1], spread[1]);
        xy = dot(spread[0], spread[1]);
        xx = x + eps, yy = y + eps;
        determinant = fma(eps, x + y, fma(eps, eps, sharp));
        a = simd::square_root(broadcast(KAPPA) * yy / determinant);
        b = broadcast(0.0f) - xy / yy * a;
        c = simd::square_root(broadcast(KAPPA) / yy);
        compensation = scene.antialiased ? simd::square_root(sharp / determinant) : broadcast(1.0f);
        opacity = in.opacity * compensation;
    }

   private:
    void normalise(const Floats (&q)[4]) {
        // By the largest component first, so that no length under- or overflows.
        const Floats sign = broadcast(-1.0f);
        Floats largest = simd::maximum(q[0], sign * q[0]);
        for (int j = 1; j < 4; ++j) largest = simd::maximum(largest, simd::maximum(q[j], sign * q[j]));
        const Floats shrink = broadcast(1.0f) / largest;
        Floats length = broadcast(0.0f);
        for (int j = 0; j < 4; ++j) unit[j] = q[j] * shrink, length = fma(unit[j], unit[j], length);
        const Floats inverse = broadcast(1.0f) / simd::square_root(length);
        for (int j = 0; j < 4; ++j) unit[j] *= inverse;
        inverse_length = inverse * shrink;
    }

    void turn_by_quaternion() {
        const Floats w = unit[0], x = unit[1], y = unit[2], z = unit[3], one = broadcast(1.0f), two = broadcast(2.0f);
        turn[0][0] = one - two * (y * y + z * z), turn[0][1] = two * (x * y - w * z), turn[0][2] = two * (x * z + w * y);
        turn[1][0] = two * (x * y + w * z), turn[1][1] = one - two * (x * x + z * z), turn[1][2] = two * (y * z - w * x);
        turn[2][0] = two * (x * z - w * y), turn[2][1] = two * (y * z + w * x), turn[2][2] = one - two * (x * x + y * y);
    }
};

}  // namespace
}  // namespace MESHANIM_NAMESPACE
