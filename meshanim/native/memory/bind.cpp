// meshanim._native.empty: outputs from the pool.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <vector>

#include "pool.h"

namespace nb = nanobind;

namespace {

using Buffer = nb::ndarray<nb::pytorch, float, nb::device::cpu>;

Buffer empty(const std::vector<size_t> &shape) {
    size_t count = 1;
    for (const size_t extent : shape) count *= extent;
    if (count == 0) throw std::invalid_argument("memory: a buffer needs at least one element");
    memory::Lease *const lease = new memory::Lease(count * sizeof(float));
    const nb::capsule owner(lease, [](void *p) noexcept { delete static_cast<memory::Lease *>(p); });
    return Buffer(lease->data(), shape.size(), shape.data(), owner);
}

}  // namespace

void bind_memory(nb::module_ &m) {
    m.def("empty", &empty, "A float32 tensor, uninitialised, whose memory goes back to a pool.", nb::arg("shape"));
    m.def("pool_bytes", [] { return memory::pool().bytes(); }, "Bytes of the pool in use, idle, and the most ever in use.");
}
