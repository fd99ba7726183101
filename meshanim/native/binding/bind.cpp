// meshanim._native.binding_forward and binding_backward (gaussians/binding_native.py calls them).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "binding.h"
#include "isa.h"

namespace nb = nanobind;
using namespace nb::literals;

MESHANIM_DECLARE(void binding_forward(const BindingForward &))
MESHANIM_DECLARE(void binding_backward(const BindingBackward &))

namespace {

template <class T, class Shape> using Contiguous = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
template <int WIDTH> using Rows = Contiguous<float, nb::shape<-1, -1, WIDTH>>;
using Triples = Contiguous<const int32_t, nb::shape<-1, 3>>;
using Indices = Contiguous<const int32_t, nb::ndim<1>>;

void require(bool condition, const char *what) {
    if (!condition) throw std::invalid_argument(what);
}

BindingSizes sizes_of(const Rows<3> &vertices, const Triples &corners, const Indices &face, int threads) {
    require(threads > 0, "binding: threads must be positive");
    return {int64_t(vertices.shape(0)), int64_t(vertices.shape(1)), int64_t(corners.shape(0)), int64_t(face.shape(0)),
            threads};
}

// A field of one frame is every frame's.
template <class Array> BindingField field(const Array &rows, const BindingSizes &sizes) {
    require(int64_t(rows.shape(1)) == sizes.gaussians, "binding: a field has another number of Gaussians");
    require(rows.shape(0) == 1 || int64_t(rows.shape(0)) == sizes.frames, "binding: a field has another batch");
    return {rows.data(), rows.shape(0) == 1 ? 0 : int64_t(rows.shape(2)) * sizes.gaussians};
}

template <class Array> float *whole(const Array &rows, int64_t frames, int64_t count) {
    require(int64_t(rows.shape(0)) == frames && int64_t(rows.shape(1)) == count, "binding: a batch has another shape");
    return rows.data();
}

BindingRows rows_of(const Indices &offsets, const Indices &items, int64_t rows, int64_t count) {
    require(int64_t(offsets.shape(0)) == rows + 1 && int64_t(items.shape(0)) == count,
            "binding: the lists of a mesh have another length");
    return {offsets.data(), items.data()};
}

void forward(Rows<3> vertices, Triples corners, Indices face, Rows<3> means, Rows<4> quaternions, Rows<3> scales,
             int threads, Rows<8> triangles, Rows<3> world_means, Rows<4> world_quaternions, Rows<3> world_scales) {
    BindingForward a{};
    const BindingSizes s = a.sizes = sizes_of(vertices, corners, face, threads);
    a.vertices = vertices.data();
    a.corners = corners.data();
    a.face = face.data();
    a.fields[0] = field(means, s);
    a.fields[1] = field(quaternions, s);
    a.fields[2] = field(scales, s);
    a.triangles = whole(triangles, s.frames, s.faces);
    a.world_means = whole(world_means, s.frames, s.gaussians);
    a.world_quaternions = whole(world_quaternions, s.frames, s.gaussians);
    a.world_scales = whole(world_scales, s.frames, s.gaussians);
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(binding_forward, a);
}

void backward(Rows<3> vertices, Triples corners, Indices face, Indices face_offsets, Indices face_gaussians,
              Indices vertex_offsets, Indices vertex_corners, Rows<3> means, Rows<4> quaternions, Rows<3> scales,
              Rows<8> triangles, Rows<3> grad_world_means, Rows<4> grad_world_quaternions, Rows<3> grad_world_scales,
              int threads, Rows<3> grad_means, Rows<4> grad_quaternions, Rows<3> grad_scales, Rows<3> grad_vertices,
              Contiguous<float, nb::ndim<1>> scratch) {
    BindingBackward a{};
    const BindingSizes s = a.sizes = sizes_of(vertices, corners, face, threads);
    a.vertices = vertices.data();
    a.corners = corners.data();
    a.face = face.data();
    a.gaussians_of_face = rows_of(face_offsets, face_gaussians, s.faces, s.gaussians);
    a.corners_of_vertex = rows_of(vertex_offsets, vertex_corners, s.vertices, 3 * s.faces);
    a.fields[0] = field(means, s);
    a.fields[1] = field(quaternions, s);
    a.fields[2] = field(scales, s);
    a.triangles = whole(triangles, s.frames, s.faces);
    a.grad_world_means = whole(grad_world_means, s.frames, s.gaussians);
    a.grad_world_quaternions = whole(grad_world_quaternions, s.frames, s.gaussians);
    a.grad_world_scales = whole(grad_world_scales, s.frames, s.gaussians);
    a.grad_fields[0] = field(grad_means, s);
    a.grad_fields[1] = field(grad_quaternions, s);
    a.grad_fields[2] = field(grad_scales, s);
    if (grad_vertices.shape(0)) {
        a.grad_vertices = whole(grad_vertices, s.frames, s.vertices);
        require(int64_t(scratch.shape(0)) == 4 * s.gaussians + 9 * s.faces, "binding: scratch has another length");
        a.scratch = scratch.data();
    }
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(binding_backward, a);
}

}  // namespace

void bind_binding(nb::module_ &m) {
    m.def("binding_forward", &forward, "Gaussians from their triangles' frames to the world.",
          "vertices"_a.noconvert(), "corners"_a.noconvert(), "face"_a.noconvert(), "means"_a.noconvert(),
          "quaternions"_a.noconvert(), "scales"_a.noconvert(), "threads"_a, "triangles"_a.noconvert(),
          "world_means"_a.noconvert(), "world_quaternions"_a.noconvert(), "world_scales"_a.noconvert());
    m.def("binding_backward", &backward,
          "Gradients of binding_forward; those of vertices only if grad_vertices is not empty.",
          "vertices"_a.noconvert(), "corners"_a.noconvert(), "face"_a.noconvert(), "face_offsets"_a.noconvert(),
          "face_gaussians"_a.noconvert(), "vertex_offsets"_a.noconvert(), "vertex_corners"_a.noconvert(),
          "means"_a.noconvert(), "quaternions"_a.noconvert(), "scales"_a.noconvert(), "triangles"_a.noconvert(),
          "grad_world_means"_a.noconvert(), "grad_world_quaternions"_a.noconvert(),
          "grad_world_scales"_a.noconvert(), "threads"_a, "grad_means"_a.noconvert(),
          "grad_quaternions"_a.noconvert(), "grad_scales"_a.noconvert(), "grad_vertices"_a.noconvert(),
          "scratch"_a.noconvert());
}
