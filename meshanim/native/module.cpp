// The extension meshanim._native: one bind function a kernel folder.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <stdexcept>
#include <string>

#include "isa.h"

namespace nb = nanobind;

static const char *const NAMES[] = {"generic", "avx2", "avx512"};

Isa best_isa() {
#ifdef MESHANIM_X86
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
        return Isa::avx512;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return Isa::avx2;
#endif
    return Isa::generic;
}

static Isa &selected() {
    static Isa isa = best_isa();
    return isa;
}

Isa current_isa() { return selected(); }

void bind_attention(nb::module_ &m);
void bind_binding(nb::module_ &);
void bind_boxqp(nb::module_ &);
void bind_colors(nb::module_ &);
void bind_image(nb::module_ &);
void bind_memory(nb::module_ &);
void bind_noise(nb::module_ &);
void bind_raster(nb::module_ &);
void bind_splat(nb::module_ &);

NB_MODULE(_native, m) {
    m.doc() = "Compiled kernels of meshanim.";
    m.def("instruction_set", [] { return std::string(NAMES[int(selected())]); },
          "The instruction set that the kernels run on now: generic, avx2 or avx512.");
    m.def("set_instruction_set", [](const std::string &name) {
        for (int i = 0; i <= int(best_isa()); ++i)
            if (name == NAMES[i]) {
                selected() = Isa(i);
                return;
            }
        throw std::invalid_argument("instruction set '" + name + "' is not available on this processor");
    }, nb::arg("name"), "Run the kernels on another instruction set (for tests); ValueError if the processor lacks it.");
    bind_attention(m);
    bind_binding(m);
    bind_boxqp(m);
    bind_colors(m);
    bind_image(m);
    bind_memory(m);
    bind_noise(m);
    bind_raster(m);
    bind_splat(m);
}
