// What the processor can do at most: chains of fused multiply-adds in registers.
#include "../simd.h"
#include "isa.h"

namespace MESHANIM_NAMESPACE {

// Runs `rounds` rounds a thread; returns the floating-point operations done.
double fused_multiply_adds(int64_t rounds, int threads, float *out) {
    constexpr int CHAINS = 12;
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int thread = 0; thread < threads; ++thread) {
        simd::Floats x[CHAINS];
        for (int i = 0; i < CHAINS; ++i) x[i] = simd::broadcast(float(thread + i));
        const simd::Floats a = simd::broadcast(0.999f), b = simd::broadcast(0.001f);
        for (int64_t round = 0; round < rounds; ++round)
            for (int i = 0; i < CHAINS; ++i) x[i] = simd::fma(x[i], a, b);
        simd::Floats total = x[0];
        for (int i = 1; i < CHAINS; ++i) total += x[i];
        out[thread] = simd::sum(total);
    }
    return 2.0 * CHAINS * simd::LANES * double(rounds) * threads;
}

}  // namespace MESHANIM_NAMESPACE
