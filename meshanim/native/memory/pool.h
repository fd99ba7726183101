// Buffers for large outputs that keep their pages from one use to the next.
//
// malloc returns large blocks to the kernel when they are freed, which then clears every page again at the next use:
// of a training step on a large mesh that was more than half the time. Here a freed block stays mapped, and the
// kernel may take a large one's pages back when memory runs short (MADV_FREE; for a small one, to say so costs more
// time than its pages are worth). Blocks in use and idle together never exceed
// 5 / 4 of the most that was in use at once: a step's phases want blocks of different sizes, and without that room
// each would drop what the next one needs.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <list>
#include <mutex>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace memory {

constexpr size_t ALIGNMENT = 64, GRAIN = 1 << 21;  // bytes; a huge page
constexpr size_t LARGE = 1 << 26;

struct Block {
    void *data;
    size_t size;
};

inline Block map(size_t size) {
#ifdef __linux__
    // Room to begin at a huge page, of which far fewer are to be looked up and given back.
    void *const data = mmap(nullptr, size + GRAIN, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (data == MAP_FAILED) throw std::bad_alloc();
    char *const from = static_cast<char *>(data), *const end = from + size + GRAIN;
    const size_t before = (GRAIN - reinterpret_cast<uintptr_t>(data) % GRAIN) % GRAIN;
    char *const start = from + before;
    if (before) munmap(from, before);
    if (start + size < end) munmap(start + size, size_t(end - start) - size);
    madvise(start, size, MADV_HUGEPAGE);
    return {start, size};
#else
    return {::operator new(size, std::align_val_t(ALIGNMENT)), size};
#endif
}

inline void unmap(const Block &block) {
#ifdef __linux__
    munmap(block.data, block.size);
#else
    ::operator delete(block.data, std::align_val_t(ALIGNMENT));
#endif
}

inline void let_reclaim(const Block &block) {
#ifdef MADV_FREE
    if (block.size >= LARGE) madvise(block.data, block.size, MADV_FREE);
#else
    (void)block;
#endif
}

class Pool {
   public:
    Block take(size_t size) {
        size = (size + GRAIN - 1) / GRAIN * GRAIN;
        const std::lock_guard<std::mutex> guard(mutex_);
        auto best = idle_.end();
        for (auto it = idle_.begin(); it != idle_.end(); ++it)
            if (it->size >= size && it->size <= size + size / 4 && (best == idle_.end() || it->size < best->size))
                best = it;
        Block block;
        if (best != idle_.end()) {
            block = *best;
            idle_.erase(best);
            idle_bytes_ -= block.size;
        } else {
            block = map(size);
        }
        used_bytes_ += block.size;
        most_used_ = std::max(most_used_, used_bytes_);
        trim();
        return block;
    }

    void give_back(const Block &block) {
        let_reclaim(block);
        const std::lock_guard<std::mutex> guard(mutex_);
        used_bytes_ -= block.size;
        idle_bytes_ += block.size;
        idle_.push_back(block);
        trim();
    }

    std::vector<size_t> bytes() {
        const std::lock_guard<std::mutex> guard(mutex_);
        return {used_bytes_, idle_bytes_, most_used_};
    }

   private:
    void trim() {  // the longest idle first
        while (!idle_.empty() && used_bytes_ + idle_bytes_ > most_used_ + most_used_ / 4) {
            unmap(idle_.front());
            idle_bytes_ -= idle_.front().size;
            idle_.pop_front();
        }
    }

    std::mutex mutex_;
    std::list<Block> idle_;
    size_t used_bytes_ = 0, idle_bytes_ = 0, most_used_ = 0;
};

// Never destroyed: tensors may outlive the module.
inline Pool &pool() {
    static Pool *const instance = new Pool;
    return *instance;
}

// A block of the pool for as long as this lives.
class Lease {
   public:
    explicit Lease(size_t bytes) : block_(pool().take(std::max<size_t>(bytes, 1))) {}
    Lease(const Lease &) = delete;
    Lease &operator=(const Lease &) = delete;
    ~Lease() { pool().give_back(block_); }
    void *data() const { return block_.data; }

   private:
    Block block_;
};

}  // namespace memory
