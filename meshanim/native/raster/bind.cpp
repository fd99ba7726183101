// meshanim._native: rasterize, and the stages of the renderer (render/frame.py puts them together).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <vector>

#include "isa.h"
#include "raster.h"

namespace nb = nanobind;
using namespace nb::literals;
using raster::Lighting;
using raster::Mesh;
using raster::Part;
using raster::Quality;
using raster::Strands;
using raster::View;

MESHANIM_DECLARE(void rasterize(const float *, int64_t, const int32_t *, int64_t, const View &, bool, int32_t *, float *,
                                float *, int))
MESHANIM_DECLARE(void apply_operator(const int32_t *, const int32_t *, const float *, int64_t, const float *, float *, int))
MESHANIM_DECLARE(void vertex_normals(const float *, int64_t, const int32_t *, int64_t, const int32_t *, const int32_t *,
                                     float *, float *, int))
MESHANIM_DECLARE(void add_patch(float *, int64_t, int, const float *, int64_t, int64_t, int64_t, int64_t, float))
MESHANIM_DECLARE(void shade(const Mesh &, const Part *, const View &, const Lighting &, const Quality &, const int32_t *,
                            const float *, const View &, const float *, float *, float *, int))
MESHANIM_DECLARE(void scatter(float *, const float *, int, int, const float *, float, float *, int))
MESHANIM_DECLARE(void develop(const float *, const float *, int, int, uint8_t *, int))
MESHANIM_DECLARE(void draw_strands(const Mesh &, const Strands &, const View &, const Lighting &, const View &,
                                   const float *, const float *, int, float *, int))

namespace {

template <class T, class Shape> using Array = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
template <class T> using Line = Array<T, nb::shape<-1>>;
template <class T> using Plane = Array<T, nb::shape<-1, -1>>;
template <class T> using Image = Array<T, nb::shape<-1, -1, -1>>;
using Points = Array<const float, nb::shape<-1, 3>>;
using Faces = Array<const int32_t, nb::shape<-1, 3>>;
using Matrix4 = Array<const double, nb::shape<4, 4>>;
using Matrix3 = Array<const double, nb::shape<3, 3>>;
using Triple = Array<const float, nb::shape<3>>;
using Release = nb::call_guard<nb::gil_scoped_release>;

void expect(bool holds, const char *what) {
    if (!holds) throw std::invalid_argument(what);
}

// The arrays behind a kernel's struct stay alive as long as it does.
struct PartHandle {
    Part part;
    std::vector<nb::object> keep{8};
    Image<const float> set(raster::Texture &texture, Image<const float> image, size_t channels, int slot) {
        expect(image.shape(2) == channels, "texture has the wrong number of channels");
        texture = {image.data(), int(image.shape(0)), int(image.shape(1))};
        keep[slot] = nb::cast(image);
        return image;
    }
};

struct MeshHandle {
    Mesh mesh;
    std::vector<nb::object> keep;
};

struct StrandsHandle {
    Strands strands;
    std::vector<nb::object> keep;
};

const float *planes_of(const Image<float> &planes, const View &view) {
    expect(planes.shape(0) == raster::PLANES && int(planes.shape(1)) == view.height && int(planes.shape(2)) == view.width,
           "planes have the wrong shape");
    return planes.data();
}

void bind_structures(nb::module_ &m) {
    nb::class_<View>(m, "View", "Camera of the raster kernels.")
        .def("__init__", [](View *self, Matrix4 world_to_camera, Matrix3 intrinsics, int width, int height, double near,
                            bool orthographic) {
            new (self) View;
            for (int i = 0; i < 12; ++i) self->world_to_camera[i] = world_to_camera.data()[i];
            const double *k = intrinsics.data();
            self->fx = k[0], self->skew = k[1], self->cx = k[2], self->fy = k[4], self->cy = k[5];
            self->near = near, self->orthographic = orthographic, self->width = width, self->height = height;
        }, "world_to_camera"_a, "intrinsics"_a, "width"_a, "height"_a, "near"_a, "orthographic"_a);

    nb::class_<Quality>(m, "Quality", "How much work a frame gets; see raster.h.")
        .def(nb::init<>())
        .def_rw("samples", &Quality::samples)
        .def_rw("shadow_taps", &Quality::shadow_taps)
        .def_rw("shadow_radius", &Quality::shadow_radius)
        .def_rw("occlusion_taps", &Quality::occlusion_taps)
        .def_rw("lobes", &Quality::lobes)
        .def_rw("scatter", &Quality::scatter)
        .def_rw("pixels_per_metre", &Quality::pixels_per_metre)
        .def("set_mouth_plane", [](Quality &self, Array<const float, nb::shape<4>> plane) {
            for (int k = 0; k < 4; ++k) self.mouth_plane[k] = plane.data()[k];
        });

    nb::class_<Lighting>(m, "Lighting", "Directional lights, sky and ground.")
        .def("__init__", [](Lighting *self, Points direction, Points color, int shadowed, Triple sky, Triple ground, Triple catch_light) {
            expect(direction.shape(0) == color.shape(0) && direction.shape(0) <= raster::MAX_LIGHTS, "at most 8 lights");
            new (self) Lighting;
            self->n = int(direction.shape(0)), self->shadowed = shadowed;
            for (int i = 0; i < self->n; ++i)
                for (int k = 0; k < 3; ++k)
                    self->direction[i][k] = direction.data()[3 * i + k], self->color[i][k] = color.data()[3 * i + k];
            for (int k = 0; k < 3; ++k)
                self->sky[k] = sky.data()[k], self->ground[k] = ground.data()[k], self->catch_light[k] = catch_light.data()[k];
        });

    nb::class_<PartHandle>(m, "Part", "Material of a group of faces; kind 0 vertex colours, 1 texture, 2 skin, 3 eye.")
        .def("__init__", [](PartHandle *self, int kind, bool scatter, float roughness, float specular) {
            expect(kind >= 0 && kind <= 3, "kind must be 0 to 3");
            new (self) PartHandle;
            self->part.kind = kind, self->part.scatter = scatter, self->part.roughness = roughness, self->part.specular = specular;
        }, "kind"_a, "scatter"_a, "roughness"_a, "specular"_a)
        .def("set_texture", [](PartHandle &self, Image<const float> image) {
            self.set(self.part.texture, image, self.part.kind == raster::SKIN ? 8 : 4, 0);
        })
        .def("set_slopes", [](PartHandle &self, Image<const float> image) { self.set(self.part.slopes, image, 4, 1); })
        .def("set_detail", [](PartHandle &self, Image<const float> image, float gain) {
            self.set(self.part.detail, image, 2, 2);
            self.part.detail_gain = gain;
        })
        .def("set_eye", [](PartHandle &self, Image<const float> iris, Image<const float> sclera) {
            self.set(self.part.iris, iris, 3, 3);
            self.set(self.part.sclera, sclera, 3, 4);
        })
        .def("set_pose", [](PartHandle &self, Triple center, float radius, Array<const float, nb::shape<3, 3>> rotation) {
            for (int k = 0; k < 3; ++k) self.part.center[k] = center.data()[k];
            for (int k = 0; k < 9; ++k) self.part.rotation[k] = rotation.data()[k];
            self.part.radius = radius;
        })
        .def("set_lids", [](PartHandle &self, Points upper, Points lower) {
            self.part.upper_lid = upper.data(), self.part.n_upper = int(upper.shape(0));
            self.part.lower_lid = lower.data(), self.part.n_lower = int(lower.shape(0));
            self.keep[5] = nb::cast(upper), self.keep[6] = nb::cast(lower);
        })
        .def("set_mouth", [](PartHandle &self, float start, float length, float floor, float power) {
            self.part.mouth_start = start, self.part.mouth_length = length, self.part.mouth_floor = floor, self.part.mouth_power = power;
        }, "start"_a, "length"_a, "floor"_a, "power"_a);

    nb::class_<MeshHandle>(m, "RenderMesh", "Posed geometry; the arrays may be written to between frames.")
        .def("__init__", [](MeshHandle *self, Points vertices, Points normals, Faces faces, Line<const uint8_t> part,
                            Image<const float> corner_uv, Line<const float> sky, Line<const float> fade, std::optional<Points> colors) {
            const size_t v = vertices.shape(0), f = faces.shape(0);
            expect(normals.shape(0) == v && sky.shape(0) == v && fade.shape(0) == v && (!colors || colors->shape(0) == v), "vertex arrays differ in length");
            expect(part.shape(0) == f && corner_uv.shape(0) == f && corner_uv.shape(1) == 3 && corner_uv.shape(2) == 2, "face arrays differ in length");
            new (self) MeshHandle;
            self->mesh = {int64_t(v), int64_t(f), vertices.data(), normals.data(), colors ? colors->data() : nullptr,
                          sky.data(), fade.data(), faces.data(), part.data(), corner_uv.data()};
            self->keep = {nb::cast(vertices), nb::cast(normals), nb::cast(faces), nb::cast(part), nb::cast(corner_uv), nb::cast(sky), nb::cast(fade), nb::cast(colors)};
        }, "vertices"_a, "normals"_a, "faces"_a, "part"_a, "corner_uv"_a, "sky"_a, "fade"_a, "colors"_a.none());

    nb::class_<StrandsHandle>(m, "Strands", "Hair that rides on triangles; see render/look/strands.py.")
        .def("__init__", [](StrandsHandle *self, Line<const int32_t> triangle, Points barycentric, Image<const float> offsets,
                            Image<const float> normals, Plane<const float> occlusion, Line<const float> width, Points color) {
            const size_t n = triangle.shape(0), k = normals.shape(1);
            expect(k >= 2 && k <= 16, "a strand has 2 to 16 points");
            expect(barycentric.shape(0) == n && offsets.shape(0) == n && normals.shape(0) == n && occlusion.shape(0) == n && width.shape(0) == n && color.shape(0) == n &&
                   offsets.shape(1) + 1 == k && occlusion.shape(1) == k && offsets.shape(2) == 3 && normals.shape(2) == 3, "strand arrays differ in length");
            new (self) StrandsHandle;
            self->strands = {int64_t(n), int(k), triangle.data(), barycentric.data(), offsets.data(), normals.data(), occlusion.data(), width.data(), color.data()};
            self->keep = {nb::cast(triangle), nb::cast(barycentric), nb::cast(offsets), nb::cast(normals), nb::cast(occlusion), nb::cast(width), nb::cast(color)};
        });
}

}  // namespace

void bind_raster(nb::module_ &m) {
    bind_structures(m);
    m.def("rasterize", [](Points vertices, Faces faces, const View &view, bool cull, Plane<int32_t> face, Plane<float> depth,
                          std::optional<Image<float>> barycentric, int threads) {
        expect(int(face.shape(0)) == view.height && int(face.shape(1)) == view.width && int(depth.shape(0)) == view.height && int(depth.shape(1)) == view.width,
               "buffers have the wrong shape");
        MESHANIM_DISPATCH(rasterize, vertices.data(), int64_t(vertices.shape(0)), faces.data(), int64_t(faces.shape(0)), view,
                          cull, face.data(), depth.data(), barycentric ? barycentric->data() : nullptr, threads);
    }, "vertices"_a, "faces"_a, "view"_a, "cull"_a, "face"_a, "depth"_a, "barycentric"_a.none(), "threads"_a, Release());
    m.def("apply_operator", [](Line<const int32_t> row_start, Line<const int32_t> columns, Line<const float> values,
                               Points points, Array<float, nb::shape<-1, 3>> out, int threads) {
        expect(row_start.shape(0) == out.shape(0) + 1, "operator and output differ in rows");
        MESHANIM_DISPATCH(apply_operator, row_start.data(), columns.data(), values.data(), int64_t(out.shape(0)), points.data(), out.data(), threads);
    }, "row_start"_a, "columns"_a, "values"_a, "points"_a, "out"_a, "threads"_a, Release());
    m.def("vertex_normals", [](Points vertices, Faces faces, Line<const int32_t> incident_start, Line<const int32_t> incident,
                               Array<float, nb::shape<-1, 3>> face_normals, Array<float, nb::shape<-1, 3>> normals, int threads) {
        expect(incident_start.shape(0) == vertices.shape(0) + 1 && face_normals.shape(0) == faces.shape(0) && normals.shape(0) == vertices.shape(0), "arrays differ in length");
        MESHANIM_DISPATCH(vertex_normals, vertices.data(), int64_t(vertices.shape(0)), faces.data(), int64_t(faces.shape(0)),
                          incident_start.data(), incident.data(), face_normals.data(), normals.data(), threads);
    }, "vertices"_a, "faces"_a, "incident_start"_a, "incident"_a, "face_normals"_a, "normals"_a, "threads"_a, Release());
    m.def("add_patch", [](Image<float> target, Image<const float> patch, int64_t row, int64_t column, float amplitude) {
        expect(row >= 0 && column >= 0 && row + patch.shape(0) <= target.shape(0) && column + patch.shape(1) <= target.shape(1) && patch.shape(2) == target.shape(2), "patch outside the texture");
        MESHANIM_DISPATCH(add_patch, target.data(), int64_t(target.shape(1)), int(target.shape(2)), patch.data(), int64_t(patch.shape(0)), int64_t(patch.shape(1)), row, column, amplitude);
    }, "target"_a, "patch"_a, "row"_a, "column"_a, "amplitude"_a, Release());
    m.def("shade", [](const MeshHandle &mesh, const std::vector<PartHandle *> &handles, const View &view, const Lighting &lighting,
                      const Quality &quality, Plane<const int32_t> face, Plane<const float> depth, const View &light,
                      std::optional<Plane<const float>> map, Image<float> planes, Plane<float> near, int threads) {
        planes_of(planes, view);
        expect(int(face.shape(0)) == view.height * quality.samples && int(face.shape(1)) == view.width * quality.samples && quality.samples >= 1 && quality.samples <= 2, "visibility has the wrong shape");
        std::vector<Part> parts;
        for (const PartHandle *handle : handles) parts.push_back(handle->part);
        nb::gil_scoped_release release;
        MESHANIM_DISPATCH(shade, mesh.mesh, parts.data(), view, lighting, quality, face.data(), depth.data(), light,
                          map ? map->data() : nullptr, planes.data(), near.data(), threads);
    }, "mesh"_a, "parts"_a, "view"_a, "lighting"_a, "quality"_a, "face"_a, "depth"_a, "light"_a, "map"_a.none(), "planes"_a, "near"_a, "threads"_a);
    m.def("scatter", [](Image<float> planes, Plane<const float> near, Array<const float, nb::shape<2, 3>> sigma, float wide_share,
                        Image<float> scratch, int threads) {
        expect(scratch.shape(0) >= 4 && scratch.shape(1) == planes.shape(1) && scratch.shape(2) == planes.shape(2), "scratch has the wrong shape");
        MESHANIM_DISPATCH(scatter, planes.data(), near.data(), int(planes.shape(2)), int(planes.shape(1)), sigma.data(), wide_share, scratch.data(), threads);
    }, "planes"_a, "near"_a, "sigma"_a, "wide_share"_a, "scratch"_a, "threads"_a, Release());
    m.def("draw_strands", [](const MeshHandle &mesh, const StrandsHandle &strands, const View &view, const Lighting &lighting,
                             const View &light, std::optional<Plane<const float>> map, Plane<const float> depth, int samples,
                             Image<float> planes, int threads) {
        planes_of(planes, view);
        MESHANIM_DISPATCH(draw_strands, mesh.mesh, strands.strands, view, lighting, light, map ? map->data() : nullptr, depth.data(), samples, planes.data(), threads);
    }, "mesh"_a, "strands"_a, "view"_a, "lighting"_a, "light"_a, "map"_a.none(), "depth"_a, "samples"_a, "planes"_a, "threads"_a, Release());
    m.def("develop", [](Image<const float> planes, Image<const float> background, Image<uint8_t> image, int threads) {
        expect(background.shape(0) == planes.shape(1) && background.shape(1) == planes.shape(2) && background.shape(2) == 3, "background has the wrong shape");
        MESHANIM_DISPATCH(develop, planes.data(), background.data(), int(planes.shape(2)), int(planes.shape(1)), image.data(), threads);
    }, "planes"_a, "background"_a, "image"_a, "threads"_a, Release());
}
