// SPDX-License-Identifier: Apache-2.0
// Vectors of N doubles, as many registers as the processor needs for them.
#pragma once
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

// There is no level for AVX-512: it would spare 6% of a solve in space, and be compiled everywhere.
#if defined(__AVX__)
constexpr int WIDTH = 4;
#else
constexpr int WIDTH = 2;
#endif

#define INLINE inline __attribute__((always_inline))
// Else what a short loop goes through is in memory, and not in registers.
#define UNROLL _Pragma("GCC unroll 16")
// Arrays do not overlap, which the compiler is told: else it takes one entry after the other.
#define NO_OVERLAP _Pragma("GCC ivdep")

// GCC takes these only with sizes that depend on no template.
template <int W> struct RegisterOf;
#define REGISTER(W) \
    template <> struct RegisterOf<W> { \
        typedef double Type __attribute__((vector_size(8 * W))); \
        typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias)); \
    };
REGISTER(2) REGISTER(4)

template <int N> struct Lanes {
    static constexpr int W = N < WIDTH ? N : WIDTH, PARTS = N / W;
    using Register = typename RegisterOf<W>::Type;
    using Unaligned = typename RegisterOf<W>::Unaligned;
    Register part[PARTS];

    static INLINE Lanes zero() {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = Register{};
        return all;
    }
    static INLINE Lanes load(const double* from) {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++)
            all.part[p] = *reinterpret_cast<const Unaligned*>(from + p * W);
        return all;
    }
    INLINE void store(double* to) const {
        UNROLL for (int p = 0; p < PARTS; p++) *reinterpret_cast<Unaligned*>(to + p * W) = part[p];
    }
    // The first few lanes, zero in the others; and these alone written.
    static INLINE Lanes load(const double* from, int count) {
        Lanes all;
        if (count == N) return load(from);
        UNROLL for (int p = 0; p < PARTS; p++) {
            Register r{};
            int left = count - p * W;
#if defined(__AVX__)
            if constexpr (W == 4) {
                const double* at = from + p * W;
                all.part[p] = (Register)(
                    left >= 4   ? _mm256_loadu_pd(at)
                    : left == 2 ? _mm256_zextpd128_pd256(_mm_loadu_pd(at))
                                : _mm256_maskload_pd(at, mask(left)));
                continue;
            }
#endif
            for (int k = 0; k < W; k++) r[k] = k < left ? from[p * W + k] : 0.0;
            all.part[p] = r;
        }
        return all;
    }
    INLINE void store(double* to, int count) const {
        if (count == N) return store(to);
        UNROLL for (int p = 0; p < PARTS; p++) {
            int left = count - p * W;
#if defined(__AVX__)
            // By parts: a masked store takes many times as long on some processors.
            if constexpr (W == 4) {
                const __m128d low = _mm256_castpd256_pd128((__m256d)part[p]);
                if (left >= 4) {
                    _mm256_storeu_pd(to + p * W, (__m256d)part[p]);
                } else if (left >= 2) {
                    _mm_storeu_pd(to + p * W, low);
                    if (left == 3)
                        _mm_store_sd(to + p * W + 2, _mm256_extractf128_pd((__m256d)part[p], 1));
                } else if (left == 1) {
                    _mm_store_sd(to + p * W, low);
                }
                continue;
            }
#endif
            for (int k = 0; k < W; k++)
                if (k < left) to[p * W + k] = part[p][k];
        }
    }
#if defined(__AVX__)
    static INLINE __m256i mask(int left) {
        static const int64_t table[8] = {-1, -1, -1, -1, 0, 0, 0, 0};
        left = left < 0 ? 0 : left > 4 ? 4 : left;
        return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(table + 4 - left));
    }
#endif
    INLINE void add(double factor, const Lanes& other) {
        UNROLL for (int p = 0; p < PARTS; p++) part[p] += factor * other.part[p];
    }
    INLINE void take(double factor, const Lanes& other) {
        UNROLL for (int p = 0; p < PARTS; p++) part[p] -= factor * other.part[p];
    }
    INLINE double operator[](int k) const { return part[k / W][k % W]; }
    INLINE Lanes operator-(const Lanes& other) const {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = part[p] - other.part[p];
        return all;
    }
    INLINE Lanes operator+(const Lanes& other) const {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = part[p] + other.part[p];
        return all;
    }
    INLINE Lanes operator*(const Lanes& other) const {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = part[p] * other.part[p];
        return all;
    }
    INLINE Lanes operator*(double factor) const {
        Lanes all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = part[p] * factor;
        return all;
    }
};
