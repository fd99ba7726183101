// Threads that go through several stages together, in one parallel region.
//
// A region a stage costs more than a small stage itself where waiting threads sleep (OMP_WAIT_POLICY=passive), for each
// region wakes them. Here they meet at a barrier that looks for the others a while before it lets them run. The
// functions have internal linkage, for kernels are compiled once an instruction set.
#pragma once
#include <atomic>
#include <cstdint>
#include <exception>
#include <thread>

#ifdef _OPENMP
#include <omp.h>
#endif
#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#endif

namespace team {

struct Shared {
    std::atomic<int> arrived{0}, generation{0};
    std::atomic<int64_t> next{0};   // of the tasks that are given out
    std::atomic<bool> failed{false};
    std::exception_ptr error;
};

// One thread's view. Work may be split by rank and size in any way that gives the same result for every size.
struct Member {
    Shared *shared;
    int rank, size;
};

struct Stop {};   // thrown on every thread once one of them has failed in `alone`

namespace {

// Until all members have come here; what they wrote before is seen after.
[[maybe_unused]] inline void wait(const Member &member) {
    if (member.size == 1) {
        member.shared->next.store(0, std::memory_order_relaxed);
        return;
    }
    constexpr int LOOKS = 4000;   // tens of microseconds
    Shared &shared = *member.shared;
    const int generation = shared.generation.load(std::memory_order_acquire);
    if (shared.arrived.fetch_add(1, std::memory_order_acq_rel) + 1 == member.size) {
        shared.next.store(0, std::memory_order_relaxed);
        shared.arrived.store(0, std::memory_order_relaxed);
        shared.generation.store(generation + 1, std::memory_order_release);
        return;
    }
    for (int look = 0; shared.generation.load(std::memory_order_acquire) == generation; ++look) {
        if (look >= LOOKS) {
            std::this_thread::yield();
            continue;
        }
#if defined(__x86_64__) || defined(_M_X64)
        _mm_pause();
#endif
    }
}

// task(i) for this member's share of 0 <= i < tasks, one after the other.
template <class Task>
inline void each(const Member &member, int64_t tasks, Task task) {
    const int64_t end = tasks * (member.rank + 1) / member.size;
    for (int64_t i = tasks * member.rank / member.size; i < end; ++i) task(i);
}

// The same, whoever is free taking the next `grain` tasks. `wait` must follow.
template <class Task>
inline void take(const Member &member, int64_t tasks, int64_t grain, Task task) {
    for (;;) {
        const int64_t begin = member.shared->next.fetch_add(grain, std::memory_order_relaxed);
        if (begin >= tasks) return;
        for (int64_t i = begin; i < begin + grain && i < tasks; ++i) task(i);
    }
}

// task() on one thread while the others wait, before and after. What it throws, `run` throws.
template <class Task>
inline void alone(const Member &member, Task task) {
    wait(member);
    if (member.rank == 0) {
        try {
            task();
        } catch (...) {
            member.shared->error = std::current_exception();
            member.shared->failed = true;
        }
    }
    wait(member);
    if (member.shared->failed) throw Stop();
}

// work(member) on up to `threads` threads at once.
template <class Work>
inline void run(int threads, Work work) {
    Shared shared;
    auto of_member = [&](int rank, int size) {
        try {
            work(Member{&shared, rank, size});
        } catch (const Stop &) {
        }
    };
    if (threads == 1) {
        of_member(0, 1);
    } else {
#pragma omp parallel num_threads(threads)
        {
#ifdef _OPENMP
            of_member(omp_get_thread_num(), omp_get_num_threads());
#else
            of_member(0, 1);
#endif
        }
    }
    if (shared.error) std::rethrow_exception(shared.error);
}

}  // namespace
}  // namespace team
