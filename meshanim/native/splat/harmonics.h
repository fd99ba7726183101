// Real spherical harmonics up to degree 3, Kerbl's order and signs (gaussians/harmonics.py), and their gradient.
#pragma once

#include "../simd.h"

namespace MESHANIM_NAMESPACE {
namespace {

template <class T>
inline void harmonics(int coefficients, T x, T y, T z, T *out) {
    auto k = [](float value) { return simd::broadcast(value); };
    out[0] = k(0.28209479177387814f);
    if (coefficients < 4) return;
    out[1] = k(-0.4886025119029199f) * y, out[2] = k(0.4886025119029199f) * z, out[3] = k(-0.4886025119029199f) * x;
    if (coefficients < 9) return;
    const T xx = x * x, yy = y * y, zz = z * z, four = k(4.0f), three = k(3.0f), two = k(2.0f);
    out[4] = k(1.0925484305920792f) * x * y;
    out[5] = k(-1.0925484305920792f) * y * z;
    out[6] = k(0.31539156525252005f) * (two * zz - xx - yy);
    out[7] = k(-1.0925484305920792f) * x * z;
    out[8] = k(0.5462742152960396f) * (xx - yy);
    if (coefficients < 16) return;
    out[9] = k(-0.5900435899266435f) * y * (three * xx - yy);
    out[10] = k(2.890611442640554f) * x * y * z;
    out[11] = k(-0.4570457994644658f) * y * (four * zz - xx - yy);
    out[12] = k(0.3731763325901154f) * z * (two * zz - three * xx - three * yy);
    out[13] = k(-0.4570457994644658f) * x * (four * zz - xx - yy);
    out[14] = k(1.445305721320277f) * z * (xx - yy);
    out[15] = k(-0.5900435899266435f) * x * (xx - three * yy);
}

// From the gradient g of the values to that of (x, y, z).
template <class T>
inline void harmonics_backward(int coefficients, T x, T y, T z, const T *g, T &gx, T &gy, T &gz) {
    auto k = [](float value) { return simd::broadcast(value); };
    gx = gy = gz = k(0.0f);
    if (coefficients < 4) return;
    const T one = k(0.4886025119029199f);
    gx -= one * g[3], gy -= one * g[1], gz += one * g[2];
    if (coefficients < 9) return;
    const T a = k(1.0925484305920792f), b = k(0.6307831305050401f), two_b = k(1.2615662610100802f);
    gx += a * (y * g[4] - z * g[7] + x * g[8]) - b * x * g[6];
    gy += a * (x * g[4] - z * g[5] - y * g[8]) - b * y * g[6];
    gz += two_b * z * g[6] - a * (y * g[5] + x * g[7]);
    if (coefficients < 16) return;
    const T xx = x * x, yy = y * y, zz = z * z, two = k(2.0f), three = k(3.0f), four = k(4.0f), six = k(6.0f), eight = k(8.0f);
    const T c = k(0.5900435899266435f), d = k(2.890611442640554f), e = k(0.4570457994644658f), f = k(0.3731763325901154f);
    const T h = k(1.445305721320277f);
    gx += d * y * z * g[10] + e * two * x * y * g[11] - f * six * x * z * g[12] - e * (four * zz - three * xx - yy) * g[13] +
          h * two * x * z * g[14] - c * (six * x * y * g[9] + three * (xx - yy) * g[15]);
    gy += d * x * z * g[10] - e * (four * zz - xx - three * yy) * g[11] - f * six * y * z * g[12] + e * two * x * y * g[13] -
          h * two * y * z * g[14] - c * (three * (xx - yy) * g[9] - six * x * y * g[15]);
    gz += d * x * y * g[10] - e * eight * z * (y * g[11] + x * g[13]) + f * (six * zz - three * (xx + yy)) * g[12] +
          h * (xx - yy) * g[14];
}

}  // namespace
}  // namespace MESHANIM_NAMESPACE
