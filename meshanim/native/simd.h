// One vector of floats for every instruction set: 16 lanes on AVX-512, 8 on AVX2, 4 in portable C++.
//
// Include it in a *.kernel.cpp and use `simd::` inside namespace MESHANIM_NAMESPACE. Loads and stores need no
// alignment. A comment "b on NaN" says which operand survives, so that a NaN is never dropped unnoticed.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "isa.h"

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

namespace MESHANIM_NAMESPACE {
namespace simd {

constexpr float INF = std::numeric_limits<float>::infinity();

#if defined(__AVX512F__)

constexpr int LANES = 16;
using Floats = __m512;

inline __mmask16 first_lanes(int n) { return __mmask16((1u << n) - 1u); }
inline Floats broadcast(float x) { return _mm512_set1_ps(x); }
inline Floats load(const float *p) { return _mm512_loadu_ps(p); }
inline void store(float *p, Floats a) { _mm512_storeu_ps(p, a); }
inline void stream(float *p, Floats a) { _mm512_stream_ps(p, a); }
// The first n lanes, 0 <= n <= LANES; zeros beyond.
inline Floats load_first(const float *p, int n) { return _mm512_maskz_loadu_ps(first_lanes(n), p); }
inline void store_first(float *p, Floats a, int n) { _mm512_mask_storeu_ps(p, first_lanes(n), a); }
inline Floats fma(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a, b, c); }
inline Floats fnma(Floats a, Floats b, Floats c) { return _mm512_fnmadd_ps(a, b, c); }  // c - a b
inline Floats maximum(Floats a, Floats b) { return _mm512_max_ps(a, b); }  // b on NaN
inline Floats minimum(Floats a, Floats b) { return _mm512_min_ps(a, b); }  // b on NaN
inline Floats round(Floats a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
inline Floats square_root(Floats a) { return _mm512_sqrt_ps(a); }
inline Floats magnitude(Floats a) { return _mm512_andnot_ps(_mm512_set1_ps(-0.0f), a); }
inline Floats negative(Floats a) { return _mm512_or_ps(_mm512_set1_ps(-0.0f), a); }  // minus the magnitude
// a times two to the power n, n whole and within +-300.
inline Floats scale_by_power(Floats a, Floats n) { return _mm512_scalef_ps(a, n); }
inline Floats power_of_two(Floats n) { return _mm512_scalef_ps(_mm512_set1_ps(1.0f), n); }  // n whole, -126 to 127

// Lane i is p[offsets[i]].
inline Floats gather(const float *p, const int32_t *offsets) { return _mm512_i32gather_ps(_mm512_loadu_si512(offsets), p, 4); }

// The lanes moved down by `distance` (a power of two), those that fall out coming in at the top.
inline Floats rotate(Floats a, int distance) {
    switch (distance) {
        case 8: return _mm512_shuffle_f32x4(a, a, 0x4e);
        case 4: return _mm512_shuffle_f32x4(a, a, 0x39);
        case 2: return _mm512_castsi512_ps(_mm512_alignr_epi32(_mm512_castps_si512(a), _mm512_castps_si512(a), 2));
        default: return _mm512_castsi512_ps(_mm512_alignr_epi32(_mm512_castps_si512(a), _mm512_castps_si512(a), 1));
    }
}

// Lane i is the sum of the lanes of rows[i].
inline Floats sums(const Floats (&rows)[LANES]) {
    Floats quads[4];
    for (int i = 0; i < 4; ++i) {
        const Floats *r = rows + 4 * i;
        const Floats ab = _mm512_unpacklo_ps(r[0], r[1]) + _mm512_unpackhi_ps(r[0], r[1]);
        const Floats cd = _mm512_unpacklo_ps(r[2], r[3]) + _mm512_unpackhi_ps(r[2], r[3]);
        const __m512d x = _mm512_castps_pd(ab), y = _mm512_castps_pd(cd);
        quads[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(x, y)) + _mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
    }
    const Floats low = _mm512_shuffle_f32x4(quads[0], quads[1], 0x88) + _mm512_shuffle_f32x4(quads[0], quads[1], 0xdd);
    const Floats high = _mm512_shuffle_f32x4(quads[2], quads[3], 0x88) + _mm512_shuffle_f32x4(quads[2], quads[3], 0xdd);
    return _mm512_shuffle_f32x4(low, high, 0x88) + _mm512_shuffle_f32x4(low, high, 0xdd);
}

using Mask = __mmask16;

inline Floats floor(Floats a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
inline Mask greater(Floats a, Floats b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }   // false on NaN
inline Mask at_least(Floats a, Floats b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }  // false on NaN
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask without(Mask a, Mask b) { return Mask(a & ~b); }
inline bool any(Mask a) { return a != 0; }
inline uint32_t bits(Mask a) { return a; }
inline Floats select(Mask where, Floats a, Floats b) { return _mm512_mask_blend_ps(where, b, a); }
inline Floats keep(Mask where, Floats a) { return _mm512_maskz_mov_ps(where, a); }  // zeros elsewhere
// Four floats, repeated.
inline Floats load_quad(const float *p) { return _mm512_broadcast_f32x4(_mm_loadu_ps(p)); }
// Lane i is a[lanes[i]].
inline Floats lookup(Floats a, const int32_t *lanes) {
    return _mm512_permutexvar_ps(_mm512_loadu_si512(lanes), a);
}
inline void store_rounded(int32_t *p, Floats a) { _mm512_storeu_si512(p, _mm512_cvtps_epi32(a)); }
// a positive and normal = 2^exponent times the result, which lies in [sqrt(1/2), sqrt(2)).
inline Floats split(Floats a, Floats &exponent) {
    const __m512i bits = _mm512_castps_si512(a), root = _mm512_set1_epi32(0x3f3504f3);
    const __m512i n = _mm512_srai_epi32(_mm512_sub_epi32(bits, root), 23);
    exponent = _mm512_cvtepi32_ps(n);
    return _mm512_castsi512_ps(_mm512_sub_epi32(bits, _mm512_slli_epi32(n, 23)));
}
// 2^x for x in [-126, 127] within 2 ulp: a table of 2^(i / 32), which is two registers, and 2^r for |r| <= 1 / 64 by
// a polynomial of degree 2 (error 6e-8).
inline Floats exp2(Floats x) {
    alignas(64) static constexpr float POWERS[32] = {
        1.0f, 1.0218972f, 1.04427373f, 1.06714046f, 1.09050775f, 1.1143868f, 1.13878858f, 1.1637249f,
        1.18920708f, 1.21524739f, 1.24185777f, 1.26905096f, 1.29683959f, 1.32523668f, 1.35425556f, 1.38390994f,
        1.41421354f, 1.44518077f, 1.47682619f, 1.50916445f, 1.54221082f, 1.5759809f, 1.61049032f, 1.64575553f,
        1.68179286f, 1.71861935f, 1.75625217f, 1.79470909f, 1.8340081f, 1.87416768f, 1.91520655f, 1.95714414f};
    const Floats grid = broadcast(393216.0f), shifted = x + grid;   // whose last bits are 32 x, rounded
    const Floats whole = shifted - grid, r = x - whole;
    const Floats power = _mm512_permutex2var_ps(_mm512_load_ps(POWERS), _mm512_castps_si512(shifted), _mm512_load_ps(POWERS + 16));
    const Floats slope = fma(broadcast(2.402265e-01f), r, broadcast(6.931573e-01f));
    return _mm512_scalef_ps(fma(power * r, slope, power), whole);
}

// Lane i of row j becomes lane j of row i.
inline void transpose(Floats (&rows)[LANES]) {
    Floats quads[16];
    for (int i = 0; i < 4; ++i) {
        const Floats *r = rows + 4 * i;
        const __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(r[0], r[1])), b = _mm512_castps_pd(_mm512_unpackhi_ps(r[0], r[1]));
        const __m512d c = _mm512_castps_pd(_mm512_unpacklo_ps(r[2], r[3])), d = _mm512_castps_pd(_mm512_unpackhi_ps(r[2], r[3]));
        quads[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
        quads[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
        quads[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
        quads[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
    }
    for (int i = 0; i < 4; ++i) {
        const Floats a = _mm512_shuffle_f32x4(quads[i], quads[4 + i], 0x44), b = _mm512_shuffle_f32x4(quads[i], quads[4 + i], 0xee);
        const Floats c = _mm512_shuffle_f32x4(quads[8 + i], quads[12 + i], 0x44), d = _mm512_shuffle_f32x4(quads[8 + i], quads[12 + i], 0xee);
        rows[i] = _mm512_shuffle_f32x4(a, c, 0x88);
        rows[4 + i] = _mm512_shuffle_f32x4(a, c, 0xdd);
        rows[8 + i] = _mm512_shuffle_f32x4(b, d, 0x88);
        rows[12 + i] = _mm512_shuffle_f32x4(b, d, 0xdd);
    }
}

// out[i] is quad i of a, repeated.
inline void spread_quads(Floats a, Floats (&out)[LANES / 4]) {
    out[0] = _mm512_shuffle_f32x4(a, a, 0x00), out[1] = _mm512_shuffle_f32x4(a, a, 0x55);
    out[2] = _mm512_shuffle_f32x4(a, a, 0xaa), out[3] = _mm512_shuffle_f32x4(a, a, 0xff);
}
// Quad i of vector j becomes quad j of vector i.
inline void transpose_quads(Floats (&v)[LANES / 4]) {
    const Floats a = _mm512_shuffle_f32x4(v[0], v[1], 0x44), b = _mm512_shuffle_f32x4(v[0], v[1], 0xee);
    const Floats c = _mm512_shuffle_f32x4(v[2], v[3], 0x44), d = _mm512_shuffle_f32x4(v[2], v[3], 0xee);
    v[0] = _mm512_shuffle_f32x4(a, c, 0x88), v[1] = _mm512_shuffle_f32x4(a, c, 0xdd);
    v[2] = _mm512_shuffle_f32x4(b, d, 0x88), v[3] = _mm512_shuffle_f32x4(b, d, 0xdd);
}

// Lane i of quad k of row j becomes lane j of quad k of row i.
inline void transpose_in_quads(Floats (&v)[4]) {
    const __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(v[0], v[1])), b = _mm512_castps_pd(_mm512_unpackhi_ps(v[0], v[1]));
    const __m512d c = _mm512_castps_pd(_mm512_unpacklo_ps(v[2], v[3])), d = _mm512_castps_pd(_mm512_unpackhi_ps(v[2], v[3]));
    v[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c)), v[1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
    v[2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d)), v[3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
}

// Quads of four floats at p, p + stride, ...
inline Floats load_quads(const float *p, int64_t stride) {
    const __m512 first = _mm512_insertf32x4(_mm512_castps128_ps512(_mm_loadu_ps(p)), _mm_loadu_ps(p + stride), 1);
    return _mm512_insertf32x4(_mm512_insertf32x4(first, _mm_loadu_ps(p + 2 * stride), 2), _mm_loadu_ps(p + 3 * stride), 3);
}
// Quads of a, b and c hold four rows of three floats each; column j of them.
inline void columns_of_quads(Floats a, Floats b, Floats c, Floats (&columns)[3]) {
    const Floats xy = _mm512_shuffle_ps(b, c, _MM_SHUFFLE(2, 1, 3, 2)), yz = _mm512_shuffle_ps(a, b, _MM_SHUFFLE(1, 0, 2, 1));
    columns[0] = _mm512_shuffle_ps(a, xy, _MM_SHUFFLE(2, 0, 3, 0));
    columns[1] = _mm512_shuffle_ps(yz, xy, _MM_SHUFFLE(3, 1, 2, 0));
    columns[2] = _mm512_shuffle_ps(yz, c, _MM_SHUFFLE(3, 0, 3, 1));
}
// Lane l of column j is p[3 l + j].
inline void load_columns(const float *p, Floats (&columns)[3]) {
    struct Picks {
        int32_t first[3][LANES], second[3][LANES];
        Picks() {
            for (int j = 0; j < 3; ++j)
                for (int l = 0; l < LANES; ++l) {
                    const int i = 3 * l + j;
                    first[j][l] = i < 2 * LANES ? i : 0;
                    second[j][l] = i < 2 * LANES ? l : i - LANES;   // of what is there already, then of the last vector
                }
        }
    };
    static const Picks picks;
    const Floats a = load(p), b = load(p + LANES), c = load(p + 2 * LANES);
    for (int j = 0; j < 3; ++j) {
        const Floats most = _mm512_permutex2var_ps(a, _mm512_loadu_si512(picks.first[j]), b);
        columns[j] = _mm512_permutex2var_ps(most, _mm512_loadu_si512(picks.second[j]), c);
    }
}
inline void store_columns(float *p, const Floats (&columns)[3]) {
    struct Picks {
        int32_t first[3][LANES], second[3][LANES];
        Picks() {
            for (int k = 0; k < 3; ++k)
                for (int l = 0; l < LANES; ++l) {
                    const int row = (LANES * k + l) / 3, column = (LANES * k + l) % 3;
                    first[k][l] = column < 2 ? column * LANES + row : 0;
                    second[k][l] = column < 2 ? l : LANES + row;
                }
        }
    };
    static const Picks picks;
    for (int k = 0; k < 3; ++k) {
        const Floats most = _mm512_permutex2var_ps(columns[0], _mm512_loadu_si512(picks.first[k]), columns[1]);
        store(p + LANES * k, _mm512_permutex2var_ps(most, _mm512_loadu_si512(picks.second[k]), columns[2]));
    }
}
// Lane l of column j is p[4 l + j].
inline void load_columns(const float *p, Floats (&columns)[4]) {
    for (int j = 0; j < 4; ++j) columns[j] = load(p + LANES * j);
    transpose_quads(columns);
    transpose_in_quads(columns);
}
inline void store_columns(float *p, const Floats (&columns)[4]) {
    Floats v[4] = {columns[0], columns[1], columns[2], columns[3]};
    transpose_in_quads(v);
    transpose_quads(v);
    for (int j = 0; j < 4; ++j) store(p + LANES * j, v[j]);
}

// Lane i of out[j] is the sum of lanes 4 j to 4 j + 3 of rows[i].
inline void quad_sums(const Floats (&rows)[LANES], Floats (&out)[LANES / 4]) {
    Floats quads[4];
    for (int i = 0; i < 4; ++i) {
        const Floats *r = rows + 4 * i;
        const __m512d x = _mm512_castps_pd(_mm512_unpacklo_ps(r[0], r[1]) + _mm512_unpackhi_ps(r[0], r[1]));
        const __m512d y = _mm512_castps_pd(_mm512_unpacklo_ps(r[2], r[3]) + _mm512_unpackhi_ps(r[2], r[3]));
        quads[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(x, y)) + _mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
    }
    transpose_quads(quads);
    for (int j = 0; j < 4; ++j) out[j] = quads[j];
}

#elif defined(__AVX2__)

constexpr int LANES = 8;
using Floats = __m256;

inline __m256i first_lanes(int n) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(n), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
}
inline Floats broadcast(float x) { return _mm256_set1_ps(x); }
inline Floats load(const float *p) { return _mm256_loadu_ps(p); }
inline void store(float *p, Floats a) { _mm256_storeu_ps(p, a); }
inline void stream(float *p, Floats a) { _mm256_stream_ps(p, a); }
inline Floats load_first(const float *p, int n) { return _mm256_maskload_ps(p, first_lanes(n)); }
inline void store_first(float *p, Floats a, int n) { _mm256_maskstore_ps(p, first_lanes(n), a); }
inline Floats fma(Floats a, Floats b, Floats c) { return _mm256_fmadd_ps(a, b, c); }
inline Floats fnma(Floats a, Floats b, Floats c) { return _mm256_fnmadd_ps(a, b, c); }
inline Floats maximum(Floats a, Floats b) { return _mm256_max_ps(a, b); }
inline Floats minimum(Floats a, Floats b) { return _mm256_min_ps(a, b); }
inline Floats square_root(Floats a) { return _mm256_sqrt_ps(a); }
inline Floats magnitude(Floats a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), a); }
inline Floats negative(Floats a) { return _mm256_or_ps(_mm256_set1_ps(-0.0f), a); }
inline Floats round(Floats a) { return _mm256_round_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
// In two halves, so that denormal results come out right.
inline Floats scale_by_power(Floats a, Floats n) {
    const __m256i whole = _mm256_cvtps_epi32(n), half = _mm256_srai_epi32(whole, 1), bias = _mm256_set1_epi32(127);
    const __m256i rest = _mm256_sub_epi32(whole, half);
    a *= _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(half, bias), 23));
    return a * _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(rest, bias), 23));
}
inline Floats power_of_two(Floats n) {
    return _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127)), 23));
}

inline Floats gather(const float *p, const int32_t *offsets) {
    return _mm256_i32gather_ps(p, _mm256_loadu_si256(reinterpret_cast<const __m256i *>(offsets)), 4);
}

inline Floats rotate(Floats a, int distance) {
    const __m256i lane = _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(distance));
    return _mm256_permutevar8x32_ps(a, lane);
}

inline Floats sums(const Floats (&rows)[LANES]) {
    Floats quads[2];
    for (int i = 0; i < 2; ++i) {
        const Floats *r = rows + 4 * i;
        const Floats ab = _mm256_unpacklo_ps(r[0], r[1]) + _mm256_unpackhi_ps(r[0], r[1]);
        const Floats cd = _mm256_unpacklo_ps(r[2], r[3]) + _mm256_unpackhi_ps(r[2], r[3]);
        const __m256d x = _mm256_castps_pd(ab), y = _mm256_castps_pd(cd);
        quads[i] = _mm256_castpd_ps(_mm256_unpacklo_pd(x, y)) + _mm256_castpd_ps(_mm256_unpackhi_pd(x, y));
    }
    return _mm256_permute2f128_ps(quads[0], quads[1], 0x20) + _mm256_permute2f128_ps(quads[0], quads[1], 0x31);
}

using Mask = __m256;

inline Floats floor(Floats a) { return _mm256_round_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
inline Mask greater(Floats a, Floats b) { return _mm256_cmp_ps(a, b, _CMP_GT_OQ); }
inline Mask at_least(Floats a, Floats b) { return _mm256_cmp_ps(a, b, _CMP_GE_OQ); }
inline Mask both(Mask a, Mask b) { return _mm256_and_ps(a, b); }
inline Mask without(Mask a, Mask b) { return _mm256_andnot_ps(b, a); }
inline uint32_t bits(Mask a) { return uint32_t(_mm256_movemask_ps(a)); }
inline bool any(Mask a) { return bits(a) != 0; }
inline Floats select(Mask where, Floats a, Floats b) { return _mm256_blendv_ps(b, a, where); }
inline Floats keep(Mask where, Floats a) { return _mm256_and_ps(where, a); }
inline Floats load_quad(const float *p) { return _mm256_broadcast_ps(reinterpret_cast<const __m128 *>(p)); }
inline Floats lookup(Floats a, const int32_t *lanes) {
    return _mm256_permutevar8x32_ps(a, _mm256_loadu_si256(reinterpret_cast<const __m256i *>(lanes)));
}
inline void store_rounded(int32_t *p, Floats a) {
    _mm256_storeu_si256(reinterpret_cast<__m256i *>(p), _mm256_cvtps_epi32(a));
}
inline Floats split(Floats a, Floats &exponent) {
    const __m256i bits = _mm256_castps_si256(a), root = _mm256_set1_epi32(0x3f3504f3);
    const __m256i n = _mm256_srai_epi32(_mm256_sub_epi32(bits, root), 23);
    exponent = _mm256_cvtepi32_ps(n);
    return _mm256_castsi256_ps(_mm256_sub_epi32(bits, _mm256_slli_epi32(n, 23)));
}
// Within 2 ulp too; a number, whatever x is, but only in that range the right one.
inline Floats exp2(Floats x) {
    const Floats n = floor(x), r = x - n;
    Floats p = broadcast(1.877576671e-03f);
    p = fma(p, r, broadcast(8.989340101e-03f));
    p = fma(p, r, broadcast(5.582631804e-02f));
    p = fma(p, r, broadcast(2.401536170e-01f));
    p = fma(p, r, broadcast(6.931530732e-01f));
    p = fma(p, r, broadcast(9.999999251e-01f));
    return _mm256_castsi256_ps(
        _mm256_add_epi32(_mm256_castps_si256(p), _mm256_slli_epi32(_mm256_cvtps_epi32(n), 23)));
}

inline void transpose(Floats (&rows)[LANES]) {
    Floats quads[8];
    for (int i = 0; i < 2; ++i) {
        const Floats *r = rows + 4 * i;
        const __m256d a = _mm256_castps_pd(_mm256_unpacklo_ps(r[0], r[1])), b = _mm256_castps_pd(_mm256_unpackhi_ps(r[0], r[1]));
        const __m256d c = _mm256_castps_pd(_mm256_unpacklo_ps(r[2], r[3])), d = _mm256_castps_pd(_mm256_unpackhi_ps(r[2], r[3]));
        quads[4 * i] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, c));
        quads[4 * i + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, c));
        quads[4 * i + 2] = _mm256_castpd_ps(_mm256_unpacklo_pd(b, d));
        quads[4 * i + 3] = _mm256_castpd_ps(_mm256_unpackhi_pd(b, d));
    }
    for (int i = 0; i < 4; ++i) {
        rows[i] = _mm256_permute2f128_ps(quads[i], quads[4 + i], 0x20);
        rows[4 + i] = _mm256_permute2f128_ps(quads[i], quads[4 + i], 0x31);
    }
}

inline void spread_quads(Floats a, Floats (&out)[LANES / 4]) {
    out[0] = _mm256_permute2f128_ps(a, a, 0x00), out[1] = _mm256_permute2f128_ps(a, a, 0x11);
}
inline void transpose_quads(Floats (&v)[LANES / 4]) {
    const Floats a = v[0];
    v[0] = _mm256_permute2f128_ps(a, v[1], 0x20);
    v[1] = _mm256_permute2f128_ps(a, v[1], 0x31);
}
inline void transpose_in_quads(Floats (&v)[4]) {
    const __m256d a = _mm256_castps_pd(_mm256_unpacklo_ps(v[0], v[1])), b = _mm256_castps_pd(_mm256_unpackhi_ps(v[0], v[1]));
    const __m256d c = _mm256_castps_pd(_mm256_unpacklo_ps(v[2], v[3])), d = _mm256_castps_pd(_mm256_unpackhi_ps(v[2], v[3]));
    v[0] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, c)), v[1] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, c));
    v[2] = _mm256_castpd_ps(_mm256_unpacklo_pd(b, d)), v[3] = _mm256_castpd_ps(_mm256_unpackhi_pd(b, d));
}
inline Floats load_quads(const float *p, int64_t stride) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p)), _mm_loadu_ps(p + stride), 1);
}
inline void columns_of_quads(Floats a, Floats b, Floats c, Floats (&columns)[3]) {
    const Floats xy = _mm256_shuffle_ps(b, c, _MM_SHUFFLE(2, 1, 3, 2)), yz = _mm256_shuffle_ps(a, b, _MM_SHUFFLE(1, 0, 2, 1));
    columns[0] = _mm256_shuffle_ps(a, xy, _MM_SHUFFLE(2, 0, 3, 0));
    columns[1] = _mm256_shuffle_ps(yz, xy, _MM_SHUFFLE(3, 1, 2, 0));
    columns[2] = _mm256_shuffle_ps(yz, c, _MM_SHUFFLE(3, 0, 3, 1));
}
inline void store_quads(float *p, float *q, Floats a) {
    _mm_storeu_ps(p, _mm256_castps256_ps128(a));
    _mm_storeu_ps(q, _mm256_extractf128_ps(a, 1));
}
inline void load_columns(const float *p, Floats (&columns)[3]) {
    columns_of_quads(load_quads(p, 12), load_quads(p + 4, 12), load_quads(p + 8, 12), columns);
}
inline void store_columns(float *p, const Floats (&columns)[3]) {
    const Floats xy = _mm256_shuffle_ps(columns[0], columns[1], _MM_SHUFFLE(2, 0, 2, 0));
    const Floats yz = _mm256_shuffle_ps(columns[1], columns[2], _MM_SHUFFLE(3, 1, 3, 1));
    const Floats zx = _mm256_shuffle_ps(columns[2], columns[0], _MM_SHUFFLE(3, 1, 2, 0));
    store_quads(p, p + 12, _mm256_shuffle_ps(xy, zx, _MM_SHUFFLE(2, 0, 2, 0)));
    store_quads(p + 4, p + 16, _mm256_shuffle_ps(yz, xy, _MM_SHUFFLE(3, 1, 2, 0)));
    store_quads(p + 8, p + 20, _mm256_shuffle_ps(zx, yz, _MM_SHUFFLE(3, 1, 3, 1)));
}
inline void load_columns(const float *p, Floats (&columns)[4]) {
    for (int j = 0; j < 4; ++j) columns[j] = load_quads(p + 4 * j, 16);
    transpose_in_quads(columns);
}
inline void store_columns(float *p, const Floats (&columns)[4]) {
    Floats v[4] = {columns[0], columns[1], columns[2], columns[3]};
    transpose_in_quads(v);
    for (int j = 0; j < 4; ++j) store_quads(p + 4 * j, p + 16 + 4 * j, v[j]);
}
inline void quad_sums(const Floats (&rows)[LANES], Floats (&out)[LANES / 4]) {
    Floats quads[2];
    for (int i = 0; i < 2; ++i) {
        const Floats *r = rows + 4 * i;
        const __m256d x = _mm256_castps_pd(_mm256_unpacklo_ps(r[0], r[1]) + _mm256_unpackhi_ps(r[0], r[1]));
        const __m256d y = _mm256_castps_pd(_mm256_unpacklo_ps(r[2], r[3]) + _mm256_unpackhi_ps(r[2], r[3]));
        quads[i] = _mm256_castpd_ps(_mm256_unpacklo_pd(x, y)) + _mm256_castpd_ps(_mm256_unpackhi_pd(x, y));
    }
    transpose_quads(quads);
    out[0] = quads[0], out[1] = quads[1];
}

#else

constexpr int LANES = 4;
struct Floats {
    float lane[LANES];
};

template <class Function>
inline Floats each(Function function) {
    Floats result;
    for (int i = 0; i < LANES; ++i) result.lane[i] = function(i);
    return result;
}
inline Floats operator+(Floats a, Floats b) { return each([&](int i) { return a.lane[i] + b.lane[i]; }); }
inline Floats operator-(Floats a, Floats b) { return each([&](int i) { return a.lane[i] - b.lane[i]; }); }
inline Floats operator*(Floats a, Floats b) { return each([&](int i) { return a.lane[i] * b.lane[i]; }); }
inline Floats operator/(Floats a, Floats b) { return each([&](int i) { return a.lane[i] / b.lane[i]; }); }
inline Floats &operator+=(Floats &a, Floats b) { return a = a + b; }
inline Floats &operator*=(Floats &a, Floats b) { return a = a * b; }
inline Floats broadcast(float x) { return each([&](int) { return x; }); }
inline Floats load(const float *p) { return each([&](int i) { return p[i]; }); }
inline void store(float *p, Floats a) { std::memcpy(p, a.lane, sizeof a); }
inline void stream(float *p, Floats a) { store(p, a); }
inline Floats load_first(const float *p, int n) { return each([&](int i) { return i < n ? p[i] : 0.0f; }); }
inline void store_first(float *p, Floats a, int n) { std::memcpy(p, a.lane, n * sizeof(float)); }
inline Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
inline Floats fnma(Floats a, Floats b, Floats c) { return c - a * b; }
inline Floats maximum(Floats a, Floats b) {
    return each([&](int i) { return a.lane[i] > b.lane[i] ? a.lane[i] : b.lane[i]; });
}
inline Floats minimum(Floats a, Floats b) {
    return each([&](int i) { return a.lane[i] < b.lane[i] ? a.lane[i] : b.lane[i]; });
}
inline Floats square_root(Floats a) { return each([&](int i) { return std::sqrt(a.lane[i]); }); }
inline Floats magnitude(Floats a) { return each([&](int i) { return std::fabs(a.lane[i]); }); }
inline Floats negative(Floats a) { return each([&](int i) { return -std::fabs(a.lane[i]); }); }
inline Floats round(Floats a) { return each([&](int i) { return std::nearbyint(a.lane[i]); }); }
inline float power_of_two(int n) {
    const uint32_t bits = uint32_t(n + 127) << 23;
    float result;
    std::memcpy(&result, &bits, sizeof result);
    return result;
}
inline Floats power_of_two(Floats n) { return each([&](int i) { return power_of_two(int(n.lane[i])); }); }
inline Floats scale_by_power(Floats a, Floats n) {
    return each([&](int i) {
        const int whole = n.lane[i] == n.lane[i] ? int(n.lane[i]) : 0, half = whole >> 1;
        return a.lane[i] * power_of_two(half) * power_of_two(whole - half);
    });
}
inline Floats gather(const float *p, const int32_t *offsets) { return each([&](int i) { return p[offsets[i]]; }); }
inline Floats rotate(Floats a, int distance) { return each([&](int i) { return a.lane[(i + distance) % LANES]; }); }
inline Floats sums(const Floats (&rows)[LANES]) {
    return each([&](int i) {
        const float *r = rows[i].lane;
        return (r[0] + r[2]) + (r[1] + r[3]);
    });
}

struct Mask {
    bool lane[LANES];
};

template <class Function>
inline Mask where(Function function) {
    Mask result;
    for (int i = 0; i < LANES; ++i) result.lane[i] = function(i);
    return result;
}
inline Floats operator-(Floats a) { return each([&](int i) { return -a.lane[i]; }); }
inline Floats &operator-=(Floats &a, Floats b) { return a = a - b; }
inline Floats floor(Floats a) { return each([&](int i) { return std::floor(a.lane[i]); }); }
inline Mask greater(Floats a, Floats b) { return where([&](int i) { return a.lane[i] > b.lane[i]; }); }
inline Mask at_least(Floats a, Floats b) { return where([&](int i) { return a.lane[i] >= b.lane[i]; }); }
inline Mask both(Mask a, Mask b) { return where([&](int i) { return a.lane[i] && b.lane[i]; }); }
inline Mask without(Mask a, Mask b) { return where([&](int i) { return a.lane[i] && !b.lane[i]; }); }
inline uint32_t bits(Mask a) { return a.lane[0] | a.lane[1] << 1 | a.lane[2] << 2 | a.lane[3] << 3; }
inline bool any(Mask a) { return bits(a) != 0; }
inline Floats select(Mask m, Floats a, Floats b) {
    return each([&](int i) { return m.lane[i] ? a.lane[i] : b.lane[i]; });
}
inline Floats keep(Mask m, Floats a) { return each([&](int i) { return m.lane[i] ? a.lane[i] : 0.0f; }); }
inline Floats load_quad(const float *p) { return load(p); }
inline Floats lookup(Floats a, const int32_t *lanes) { return each([&](int i) { return a.lane[lanes[i]]; }); }
inline void store_rounded(int32_t *p, Floats a) {
    for (int i = 0; i < LANES; ++i) p[i] = int32_t(std::nearbyint(a.lane[i]));
}
inline Floats split(Floats a, Floats &exponent) {
    return each([&](int i) {
        int n;
        float m = std::frexp(a.lane[i], &n);
        if (m < 0.70710678f) m *= 2, --n;
        exponent.lane[i] = float(n);
        return m;
    });
}
inline Floats exp2(Floats x) {
    x = maximum(broadcast(-126.0f), x);
    const Floats n = floor(x), r = x - n;
    Floats p = broadcast(1.877576671e-03f);
    p = fma(p, r, broadcast(8.989340101e-03f));
    p = fma(p, r, broadcast(5.582631804e-02f));
    p = fma(p, r, broadcast(2.401536170e-01f));
    p = fma(p, r, broadcast(6.931530732e-01f));
    p = fma(p, r, broadcast(9.999999251e-01f));
    return each([&](int i) { return p.lane[i] * power_of_two(int(n.lane[i])); });
}

inline void transpose(Floats (&rows)[LANES]) {
    for (int i = 0; i < LANES; ++i)
        for (int j = 0; j < i; ++j) std::swap(rows[i].lane[j], rows[j].lane[i]);
}
inline void spread_quads(Floats a, Floats (&out)[LANES / 4]) { out[0] = a; }
inline void transpose_quads(Floats (&)[LANES / 4]) {}
inline Floats load_quads(const float *p, int64_t) { return load(p); }
inline void columns_of_quads(Floats a, Floats b, Floats c, Floats (&columns)[3]) {
    const Floats rows[3] = {a, b, c};
    for (int j = 0; j < 3; ++j) columns[j] = each([&](int i) { return rows[(3 * i + j) / 4].lane[(3 * i + j) % 4]; });
}
template <int WIDTH>
inline void load_columns(const float *p, Floats (&columns)[WIDTH]) {
    for (int j = 0; j < WIDTH; ++j) columns[j] = each([&](int i) { return p[WIDTH * i + j]; });
}
template <int WIDTH>
inline void store_columns(float *p, const Floats (&columns)[WIDTH]) {
    for (int j = 0; j < WIDTH; ++j)
        for (int i = 0; i < LANES; ++i) p[WIDTH * i + j] = columns[j].lane[i];
}
inline void quad_sums(const Floats (&rows)[LANES], Floats (&out)[LANES / 4]) { out[0] = sums(rows); }

#endif

inline void load_columns(const float *p, Floats (&columns)[1]) { columns[0] = load(p); }
inline void store_columns(float *p, const Floats (&columns)[1]) { store(p, columns[0]); }
#if defined(__AVX2__) || defined(__AVX512F__)
inline void store_columns(float *p, const Floats (&columns)[2]) {
    float lanes[2][LANES];
    for (int j = 0; j < 2; ++j) store(lanes[j], columns[j]);
    for (int i = 0; i < 2 * LANES; ++i) p[i] = lanes[i % 2][i / 2];
}
#endif
inline Floats zeros() { return broadcast(0.0f); }

// Combine the lanes whose indices are equal modulo `period` (a power of two); every lane gets its result.
inline Floats fold_sum(Floats a, int period) {
    for (int distance = LANES / 2; distance >= period; distance /= 2) a += rotate(a, distance);
    return a;
}
inline Floats fold_maximum(Floats a, int period) {
    for (int distance = LANES / 2; distance >= period; distance /= 2) a = maximum(a, rotate(a, distance));
    return a;
}
inline float sum(Floats a) {
    float lanes[LANES];
    store(lanes, fold_sum(a, 1));
    return lanes[0];
}

// e^x within 2 ulp, denormal results included; exp(-inf) = 0, exp(inf) = inf, NaN stays NaN.
// Cody-Waite reduction to |r| <= ln(2) / 2, then a minimax polynomial of degree 6 (error 3e-9).
inline Floats exp(Floats x) {
    x = maximum(broadcast(-106.0f), minimum(broadcast(90.0f), x));
    const Floats n = round(x * broadcast(1.44269504f));
    Floats r = fma(n, broadcast(-0.693359375f), x);
    r = fma(n, broadcast(2.12194440e-4f), r);
    Floats p = broadcast(1.394197810e-03f);
    p = fma(p, r, broadcast(8.368760347e-03f));
    p = fma(p, r, broadcast(4.166638851e-02f));
    p = fma(p, r, broadcast(1.666651964e-01f));
    p = fma(p, r, broadcast(0.5f));
    p = fma(p, r, broadcast(1.0f));
    p = fma(p, r, broadcast(1.0f));
    return scale_by_power(p, n);
}

// log2 of positive normal numbers within 2 ulp.
inline Floats log2(Floats x) {
    Floats n;
    const Floats t = split(x, n) - broadcast(1.0f);
    Floats p = broadcast(1.258374164e-01f);
    p = fma(p, t, broadcast(-2.072704205e-01f));
    p = fma(p, t, broadcast(2.157157655e-01f));
    p = fma(p, t, broadcast(-2.389447421e-01f));
    p = fma(p, t, broadcast(2.879162258e-01f));
    p = fma(p, t, broadcast(-3.607036854e-01f));
    p = fma(p, t, broadcast(4.809106436e-01f));
    p = fma(p, t, broadcast(-7.213473468e-01f));
    p = fma(p, t, broadcast(1.442695004e+00f));
    return fma(p, t, n);
}

}  // namespace simd
}  // namespace MESHANIM_NAMESPACE
