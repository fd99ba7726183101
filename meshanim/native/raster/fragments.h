// The fragments of one row of pixels, a field an array, so that the light loop runs over them as vectors.
#pragma once

#include <memory>

#include "vector.h"

namespace MESHANIM_NAMESPACE {
namespace {

struct Fragments {
    std::unique_ptr<float[]> floats;
    std::unique_ptr<int[]> ints;
    int *pixel, *face, *part;
    float *coverage, *depth, *u, *v, *occlusion, *roughness, *specular, *cornea, *lit, *lining, *scatter, *open, *cosine, *sine;
    float *position[3], *normal[3], *view[3], *bumped[3], *diffuse[3], *albedo[3], *irradiance[3], *reflection[3], *wrap[3];

    explicit Fragments(int capacity) {
        float **single[] = {&coverage, &depth, &u, &v, &occlusion, &roughness, &specular, &cornea, &lit, &lining, &scatter, &open, &cosine, &sine};
        float **triple[] = {position, normal, view, bumped, diffuse, albedo, irradiance, reflection, wrap};
        // Room for a whole vector at the end. Not a multiple of a page, or all fields of a fragment would fall into the same cache set.
        const int64_t padded = (capacity + 1023) / 1024 * 1024 + 48;
        floats.reset(new float[padded * (14 + 3 * 9)]());
        ints.reset(new int[padded * 3]);
        float *next = floats.get();
        for (float **field : single) *field = next, next += padded;
        for (float **field : triple)
            for (int k = 0; k < 3; ++k) field[k] = next, next += padded;
        pixel = ints.get(), face = pixel + padded, part = face + padded;
    }
    static void set(float *const field[3], int i, Vec value) { field[0][i] = value.x, field[1][i] = value.y, field[2][i] = value.z; }
    static Vec get(float *const field[3], int i) { return {field[0][i], field[1][i], field[2][i]}; }
};

}  // namespace
}  // namespace MESHANIM_NAMESPACE
