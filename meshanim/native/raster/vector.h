// Three floats, inline in each instruction set's namespace.
#pragma once

#include <cmath>

#include "isa.h"

namespace MESHANIM_NAMESPACE {
namespace {

struct Vec {
    float x, y, z;
};

inline Vec load(const float *p) { return {p[0], p[1], p[2]}; }
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(Vec a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec operator*(Vec a, Vec b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline float length(Vec a) { return std::sqrt(dot(a, a)); }
inline Vec unit(Vec a) { return a * (1.0f / std::sqrt(dot(a, a) + 1e-24f)); }
inline float clamp(float x, float low, float high) { return x < low ? low : x > high ? high : x; }
inline float smoothstep(float a, float b, float x) {
    const float t = clamp((x - a) / (b - a), 0.0f, 1.0f);
    return t * t * (3 - 2 * t);
}

}  // namespace
}  // namespace MESHANIM_NAMESPACE
