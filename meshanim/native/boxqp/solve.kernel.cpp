// Box-constrained quadratic programs by block principal pivoting, warm-started from the frame before.
//
// Judice and Pires (1994), "A block principal pivoting algorithm for large-scale strictly monotone linear
// complementarity problems", with upper bounds: guess which weights are at a bound, solve for the others, move every
// weight that contradicts its guess; when that stops helping, move one at a time (Murty), which must end. A weight is
// moved by sweeping a table, which costs n^2 where a new factor of the free block would cost n^3 / 3.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "../isa.h"
#include "boxqp.h"

namespace MESHANIM_NAMESPACE {
namespace {

constexpr int64_t CHUNK = 32;  // frames that warm-start each other; fixed, so that threads change nothing
constexpr int64_t LANE = 8;    // doubles that are worked on together; rows are padded to a multiple
constexpr double TOLERANCE = 1e-11;
constexpr double EQUAL = 1e-9;  // weights of a pair
constexpr int PATIENCE = 3;
constexpr int64_t MOST_PIVOTS = 20;  // times the number of weights, before the table is made afresh

class Program {
   public:
    explicit Program(const BoxPrograms &p)
        : n_(p.n), stride_((p.n + LANE - 1) / LANE * LANE), gram_(size_t(n_ * stride_)), upper_(size_t(n_)),
          gradient_(size_t(stride_)), move_(size_t(stride_)), bound_(p.bound, p.bound + n_), swept_(size_t(n_)) {}

    // gram + strength * extra, where there is an extra.
    void set_gram(const double *gram, const double *extra, double strength) {
        for (int64_t i = 0; i < n_; ++i)
            for (int64_t j = 0; j < n_; ++j)
                gram_[size_t(i * stride_ + j)] = gram[i * n_ + j] + (extra ? strength * extra[i * n_ + j] : 0.0);
        restart();
    }
    const int8_t *bound() const { return bound_.data(); }

    void solve(const double *linear, double *w) {
        std::fill(upper_.begin(), upper_.end(), 1.0);
        run(linear, w);
    }

    // Of each pair the smaller weight must be zero.
    void solve_without_smaller(const double *linear, const int32_t *pairs, int64_t count, double *w) {
        for (int64_t k = 0; k < count; ++k) {
            const int32_t first = pairs[2 * k], second = pairs[2 * k + 1];
            const int32_t drop = w[first] < w[second] - EQUAL ? first : second;
            upper_[size_t(drop)] = 0.0;
        }
        run(linear, w);
    }

   private:
    void run(const double *linear, double *w) {
        double largest = 0;
        for (int64_t i = 0; i < n_; ++i) largest = std::max({largest, row(i)[i], std::abs(linear[i])});
        const double slack = TOLERANCE * largest;
        for (int64_t i = 0; i < n_; ++i)
            if (upper_[size_t(i)] == 0.0) bound_[size_t(i)] = -1;
        int64_t fewest = n_ + 1;
        int patience = PATIENCE;
        for (int64_t step = 0; step < 50 * n_ + 100; ++step) {
            place(linear, w);
            const int64_t wrong = count_wrong(w, slack);
            if (wrong == 0) {
                for (int64_t i = 0; i < n_; ++i) w[i] = std::min(1.0, std::max(0.0, w[i]));  // rounding
                return;
            }
            if (wrong < fewest) {
                fewest = wrong;
                patience = PATIENCE;
            } else if (patience > 0) {
                --patience;
            } else {
                move_last(w, slack);
                continue;
            }
            for (int64_t i = 0; i < n_; ++i) bound_[size_t(i)] = better(i, w[i], slack);
        }
        descend(linear, w, slack);
    }

    int8_t better(int64_t i, double w, double slack) const {
        if (upper_[size_t(i)] == 0.0) return -1;
        const double g = gradient_[size_t(i)];
        switch (bound_[size_t(i)]) {
            case 0: return w < -TOLERANCE ? -1 : w > 1.0 + TOLERANCE ? 1 : 0;
            case -1: return g < -slack ? 0 : -1;
            default: return g > slack ? 0 : 1;
        }
    }
    int64_t count_wrong(const double *w, double slack) const {
        int64_t count = 0;
        for (int64_t i = 0; i < n_; ++i) count += better(i, w[i], slack) != bound_[size_t(i)];
        return count;
    }
    void move_last(const double *w, double slack) {
        for (int64_t i = n_ - 1; i >= 0; --i) {
            const int8_t to = better(i, w[i], slack);
            if (to != bound_[size_t(i)]) {
                bound_[size_t(i)] = to;
                return;
            }
        }
    }

    // w with the weights at their bounds and the free ones optimal; the gradient G w - b.
    void place(const double *linear, double *w) {
        if (pivots_ > MOST_PIVOTS * n_) restart();
        for (int64_t i = 0; i < n_; ++i) {
            if ((bound_[size_t(i)] == 0) != bool(swept_[size_t(i)])) pivot(i);
            w[i] = bound_[size_t(i)] > 0 ? 1.0 : 0.0;
        }
        for (int step = 0; step < 2; ++step) {  // the second is one of iterative refinement
            slope(linear, w);
            std::fill(move_.begin(), move_.end(), 0.0);
            for (int64_t j = 0; j < n_; ++j)
                if (swept_[size_t(j)]) add(move_.data(), gradient_[size_t(j)], table_.data() + j * stride_);
            for (int64_t i = 0; i < n_; ++i)
                if (swept_[size_t(i)]) w[i] += move_[size_t(i)];
        }
        slope(linear, w);
    }

    void slope(const double *linear, const double *w) {
        double *const g = gradient_.data();
        for (int64_t i = 0; i < n_; ++i) g[i] = -linear[i];
        for (int64_t j = 0; j < n_; ++j)
            if (w[j] != 0.0) add(g, w[j], row(j));
    }

    void restart() {
        table_ = gram_;
        std::fill(swept_.begin(), swept_.end(), 0);
        pivots_ = 0;
    }

    // The table is G with its free block swept: minus the inverse of the block there, Schur complement elsewhere.
    // Sweeping k in or out is one update of rank one (Goodnight 1979, "A tutorial on the SWEEP operator").
    void pivot(int64_t k) {
        double *const own = table_.data() + k * stride_;
        const double inverse = 1.0 / own[k], sign = swept_[size_t(k)] ? -1.0 : 1.0;
        std::copy(own, own + stride_, move_.begin());
        for (int64_t i = 0; i < n_; ++i) {
            if (i == k) continue;
            double *const other = table_.data() + i * stride_;
            const double by = move_[size_t(i)] * inverse;  // the table is symmetric
            add(other, -by, move_.data());
            other[k] = sign * by;
        }
        for (int64_t j = 0; j < stride_; ++j) own[j] = sign * inverse * move_[size_t(j)];
        own[k] = -inverse;
        swept_[size_t(k)] ^= 1;
        ++pivots_;
    }

    // Cyclic coordinate descent, which always gets there: for the case that rounding kept the pivoting from ending.
    void descend(const double *linear, double *w, double slack) {
        for (int64_t i = 0; i < n_; ++i) w[i] = std::min(upper_[size_t(i)], std::max(0.0, w[i]));
        slope(linear, w);
        for (int sweep = 0; sweep < 100000; ++sweep) {
            double moved = 0;
            for (int64_t i = 0; i < n_; ++i) {
                const double slant = row(i)[i];
                const double to = std::min(upper_[size_t(i)], std::max(0.0, w[i] - gradient_[size_t(i)] / slant));
                const double by = to - w[i];
                if (by == 0.0) continue;
                w[i] = to;
                add(gradient_.data(), by, row(i));
                moved = std::max(moved, std::abs(by) * slant);
            }
            if (moved <= slack) break;
        }
        for (int64_t i = 0; i < n_; ++i)
            bound_[size_t(i)] = w[i] <= 0.0 ? -1 : w[i] >= upper_[size_t(i)] ? 1 : 0;
    }

    void add(double *y, double by, const double *x) const {
        for (int64_t j = 0; j < stride_; j += LANE)
            for (int64_t lane = 0; lane < LANE; ++lane) y[j + lane] += by * x[j + lane];
    }
    const double *row(int64_t i) const { return gram_.data() + i * stride_; }

    int64_t n_, stride_, pivots_ = 0;
    std::vector<double> gram_, table_, upper_, gradient_, move_;
    std::vector<int8_t> bound_, swept_;
};

void frames(const BoxPrograms &p, int64_t first, int64_t last, double *previous, int8_t *bound) {
    Program program(p);
    const size_t n = size_t(p.n);
    std::vector<double> linear(n);
    program.set_gram(p.gram, nullptr, 0.0);
    for (int64_t t = first; t < last; ++t) {
        double *const w = p.out + t * p.n;
        if (p.extra) program.set_gram(p.gram, p.extra, p.strength[t]);
        std::memcpy(linear.data(), p.linear + t * p.n, n * sizeof(double));
        if (p.feedback)
            for (size_t j = 0; j < n; ++j)
                if (previous[j] != 0.0)
                    for (size_t i = 0; i < n; ++i) linear[i] += previous[j] * p.feedback[j * n + i];
        program.solve(linear.data(), w);
        if (p.n_pairs) program.solve_without_smaller(linear.data(), p.pairs, p.n_pairs, w);
        if (p.feedback) std::memcpy(previous, w, n * sizeof(double));
    }
    if (bound) std::memcpy(bound, program.bound(), n);
}

}  // namespace

void box_programs(const BoxPrograms &p) {
    if (p.count == 0) return;
    if (p.feedback) {
        frames(p, 0, p.count, p.previous, p.bound);
        return;
    }
    const int64_t chunks = (p.count + CHUNK - 1) / CHUNK;
    std::vector<int8_t> last(size_t(p.n));
#pragma omp parallel for num_threads(int(std::max<int64_t>(1, std::min<int64_t>(p.threads, chunks)))) schedule(static)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const int64_t stop = std::min(p.count, (chunk + 1) * CHUNK);
        frames(p, chunk * CHUNK, stop, nullptr, stop == p.count ? last.data() : nullptr);
    }
    std::memcpy(p.bound, last.data(), size_t(p.n));
    std::memcpy(p.previous, p.out + (p.count - 1) * p.n, size_t(p.n) * sizeof(double));
}

}  // namespace MESHANIM_NAMESPACE
