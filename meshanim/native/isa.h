// Which instruction set the kernels run on, chosen once from the processor and overridable for tests.
//
// A kernel file (NAME.kernel.cpp) is compiled once an instruction set. It puts its functions into
//     namespace MESHANIM_NAMESPACE { ... }
// and bind.cpp declares them in namespaces generic, avx2 and avx512 and calls MESHANIM_DISPATCH(function, arguments).
#pragma once

enum class Isa { generic = 0, avx2 = 1, avx512 = 2 };

Isa best_isa();     // the widest that this build and this processor both have
Isa current_isa();  // what MESHANIM_DISPATCH uses

#ifdef MESHANIM_ISA
#define MESHANIM_NAMESPACE MESHANIM_ISA
#endif

#ifdef MESHANIM_X86
#define MESHANIM_DECLARE(...)             \
    namespace generic { __VA_ARGS__; }    \
    namespace avx2 { __VA_ARGS__; }       \
    namespace avx512 { __VA_ARGS__; }
#define MESHANIM_DISPATCH(function, ...)                                          \
    (current_isa() == Isa::avx512 ? avx512::function(__VA_ARGS__)                 \
     : current_isa() == Isa::avx2 ? avx2::function(__VA_ARGS__)                   \
                                  : generic::function(__VA_ARGS__))
#else
#define MESHANIM_DECLARE(...) namespace generic { __VA_ARGS__; }
#define MESHANIM_DISPATCH(function, ...) generic::function(__VA_ARGS__)
#endif
