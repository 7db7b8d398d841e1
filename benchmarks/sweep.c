/* One sweep of fuzzy c-means, m = 2, fused by hand in single precision: the floor that the library is measured against. */
#include <string.h>

void sweep(const float *restrict x, const float *restrict v, long count, double *restrict sums) {
    enum { D = 3, K = 8, LANES = 16 };
    double total[K][D + 1];
    memset(total, 0, sizeof total);
    for (long start = 0; start < count; start += 4096) {
        long end = start + 4096 < count ? start + 4096 : count;
        float part[K][D + 1][LANES];
        memset(part, 0, sizeof part);
        for (long k = start; k + LANES <= end; k += LANES) {
            float p[D][LANES], near[K][LANES], sum[LANES];
            for (int l = 0; l < LANES; l++) {
                sum[l] = 0;
                for (int d = 0; d < D; d++) p[d][l] = x[d * count + k + l];
            }
            for (int i = 0; i < K; i++)
                for (int l = 0; l < LANES; l++) {
                    float a = p[0][l] - v[i * D], b = p[1][l] - v[i * D + 1], c = p[2][l] - v[i * D + 2];
                    near[i][l] = 1.0f / (a * a + b * b + c * c + 1e-14f);
                    sum[l] += near[i][l];
                }
            for (int l = 0; l < LANES; l++) sum[l] = 1.0f / sum[l];
            for (int i = 0; i < K; i++)
                for (int l = 0; l < LANES; l++) {
                    float u = near[i][l] * sum[l], w = u * u;
                    part[i][D][l] += w;
                    for (int d = 0; d < D; d++) part[i][d][l] += w * p[d][l];
                }
        }
        for (int i = 0; i < K; i++)
            for (int d = 0; d <= D; d++)
                for (int l = 0; l < LANES; l++) total[i][d] += part[i][d][l];
    }
    memcpy(sums, total, sizeof total);
}
