// The mesh renderer's kernels: visibility (z-buffer), surfaces, deferred shading, scattering, strands, tone.
#pragma once

#include <cstdint>

namespace raster {

// World to image. Rows of world_to_camera are (R | t); a pixel is (fx x + skew y) / z + cx (z = 1 if orthographic).
struct View {
    double world_to_camera[12];
    double fx, skew, cx, fy, cy;
    double near;
    bool orthographic;
    int width, height;
};

struct Texture {
    const float *data = nullptr;   // (height, width, channels), row 0 at v = 1
    int height = 0, width = 0;
};

enum Kind { COLORED = 0, TEXTURED = 1, SKIN = 2, EYE = 3 };

// What a group of faces is made of.
struct Part {
    int kind = COLORED;
    bool scatter = false;              // takes part in the subsurface blur
    float roughness = 0.5f, specular = 1.0f;
    Texture texture;                   // TEXTURED: albedo, roughness. SKIN: look.SKIN_CHANNELS
    Texture slopes;                    // SKIN: height by u and v in metres, cavity in metres, unused
    Texture detail;                    // SKIN: tiled slopes (2 channels)
    float detail_gain = 0;
    // The mouth's inside darkens behind the lips: occlusion clamp(start - depth / length, floor, 1)^power.
    float mouth_start = 1, mouth_length = 0, mouth_floor = 1, mouth_power = 1;
    // EYE: pose, polar textures (3 channels, rows radius, columns angle), lid margins in world space.
    float center[3] = {0, 0, 0}, radius = 1, rotation[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    Texture iris, sclera;
    const float *upper_lid = nullptr, *lower_lid = nullptr;   // (n, 3)
    int n_upper = 0, n_lower = 0;
};

constexpr int MAX_LIGHTS = 8;

struct Lighting {
    int n = 0;
    float direction[MAX_LIGHTS][3];    // unit, towards the light
    float color[MAX_LIGHTS][3];        // linear, times intensity
    int shadowed = -1;                 // which light the shadow map belongs to
    float sky[3], ground[3];
    float catch_light[3];              // unit, centre of the soft box that eyes reflect
};

struct Mesh {
    int64_t n_vertices, n_faces;
    const float *vertices, *normals;   // (V, 3)
    const float *colors;               // (V, 3) linear albedo of COLORED parts, or null
    const float *sky;                  // (V,) share of the sky that is seen
    const float *fade;                 // (V,) opacity
    const int32_t *faces;              // (F, 3)
    const uint8_t *part;               // (F,)
    const float *corner_uv;            // (F, 3, 2)
};

struct Quality {
    int samples = 2;                   // visibility samples a pixel side
    int shadow_taps = 16;
    float shadow_radius = 0.003f;      // metres
    int occlusion_taps = 8;            // 0: none
    int lobes = 2;
    bool scatter = true;
    float pixels_per_metre = 1500;     // at the head, of the output
    float mouth_plane[4] = {0, 0, 0, 0};   // (x, y, z, 1) . plane = metres behind the closed lips
};

// Planes (11, height, width) that shading writes: albedo of scattering parts, finished light, irradiance of
// scattering parts (each 3, times coverage), coverage of scattering parts, opacity.
enum Plane { ALBEDO = 0, LIGHT = 3, IRRADIANCE = 6, SCATTER = 9, OPACITY = 10, PLANES = 11 };

struct Strands {
    int64_t n;
    int points;                        // a strand, root included
    const int32_t *triangle;           // (n,)
    const float *barycentric;          // (n, 3)
    const float *offsets;              // (n, points - 1, 3)
    const float *normals;              // (n, points, 3)
    const float *occlusion;            // (n, points)
    const float *width;                // (n,)
    const float *color;                // (n, 3)
};

}  // namespace raster
