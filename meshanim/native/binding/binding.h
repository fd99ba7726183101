// Gaussians bound to triangles: what the kernels read and write. Rows are contiguous floats.
#pragma once
#include <cstdint>

// A field of the Gaussians: `stride` floats from one frame to the next, 0 where all frames share it.
struct BindingField {
    float *data;
    int64_t stride;

    float *at(int64_t frame) const { return data + frame * stride; }
};

struct BindingSizes {
    int64_t frames, vertices, faces, gaussians;
    int threads;
};

struct BindingForward {
    BindingSizes sizes;
    const float *vertices;   // (frames, vertices, 3)
    const int32_t *corners;  // (faces, 3)
    const int32_t *face;     // (gaussians)
    BindingField fields[3];  // means, quaternions, scales
    float *triangles;  // (frames, faces, 8): quaternion, scale, origin
    float *world_means, *world_quaternions, *world_scales;
};

// Compressed rows: those of row r are items[offsets[r]] to items[offsets[r + 1]].
struct BindingRows {
    const int32_t *offsets, *items;
};

struct BindingBackward {
    BindingSizes sizes;
    const float *vertices;
    const int32_t *corners, *face;
    BindingRows gaussians_of_face;  // indices of Gaussians
    BindingRows corners_of_vertex;  // 3 * face + corner
    BindingField fields[3];  // means, quaternions, scales
    const float *triangles;
    const float *grad_world_means, *grad_world_quaternions, *grad_world_scales;
    BindingField grad_fields[3];
    float *grad_vertices;  // null where nobody asks
    float *scratch;        // 4 * gaussians + 9 * faces
};
