/* Stand-in for the functions of CMSIS-DSP that the Kalman filter of the Crazyflie firmware calls (docs/speed.md). */
#pragma once
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifndef PI
#define PI 3.14159265358979f
#endif
typedef float float32_t;
typedef enum { ARM_MATH_SUCCESS = 0, ARM_MATH_SINGULAR = -5 } arm_status;
typedef struct { uint16_t numRows, numCols; float *pData; } arm_matrix_instance_f32;
typedef arm_matrix_instance_f32 matrix;

static inline float arm_cos_f32(float x) { return cosf(x); }
static inline float arm_sin_f32(float x) { return sinf(x); }
static inline arm_status arm_sqrt_f32(float x, float *out) { *out = x > 0 ? sqrtf(x) : 0; return ARM_MATH_SUCCESS; }

static inline arm_status arm_mat_trans_f32(const matrix *a, matrix *out) {
  for (int i = 0; i < a->numRows; i++)
    for (int j = 0; j < a->numCols; j++) out->pData[j * a->numRows + i] = a->pData[i * a->numCols + j];
  return ARM_MATH_SUCCESS;
}

static inline arm_status arm_mat_scale_f32(const matrix *a, float scale, matrix *out) {
  for (int i = 0; i < a->numRows * a->numCols; i++) out->pData[i] = scale * a->pData[i];
  return ARM_MATH_SUCCESS;
}

static inline arm_status arm_mat_mult_f32(const matrix *a, const matrix *b, matrix *out) {
  for (int i = 0; i < a->numRows; i++)
    for (int j = 0; j < b->numCols; j++) {
      float sum = 0;
      for (int k = 0; k < a->numCols; k++) sum += a->pData[i * a->numCols + k] * b->pData[k * b->numCols + j];
      out->pData[i * b->numCols + j] = sum;
    }
  return ARM_MATH_SUCCESS;
}

/* Gauss-Jordan elimination, up to 16 x 16. Rows are not exchanged: CMSIS 5 does not, either (its search for a larger pivot
   looks at the same element again), and the robust filter inverts triangular matrices, where that matters. */
static inline arm_status arm_mat_inverse_f32(const matrix *a, matrix *out) {
  int n = a->numRows;
  float m[16][32];
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) { m[i][j] = a->pData[i * n + j]; m[i][n + j] = i == j; }
  for (int c = 0; c < n; c++) {
    float d = m[c][c];
    if (d == 0) return ARM_MATH_SINGULAR;
    for (int j = c; j < 2 * n; j++) m[c][j] /= d;
    for (int r = 0; r < n; r++) {
      float f = m[r][c];
      if (r != c) for (int j = c; j < 2 * n; j++) m[r][j] -= f * m[c][j];
    }
  }
  for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) out->pData[i * n + j] = m[i][n + j];
  return ARM_MATH_SUCCESS;
}
