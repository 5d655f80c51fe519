/* The Kalman filter of the Crazyflie firmware as a peer of `study bench --peer` (docs/notebook/speed.md).
   With -DROBUST=1 it is the M-estimation of the first paper, else the firmware's standard update. */
#include <math.h>
#include <stdint.h>
#include <string.h>
#include "kalman_core.h"
#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
#include "outlierFilterTdoa.h"

#ifndef ROBUST
#define ROBUST 0
#endif

typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
static kalmanCoreData_t core;
static kalmanCoreParams_t params;
static OutlierFilterTdoaState_t outliers;
static const double *anchors;
static int started;

void abort(void);
void assertFail(char *what, char *file, int line) { abort(); }

static point_t place(int32_t row) {
  const double *at = anchors + 3 * row;
  return (point_t){.x = at[0], .y = at[1], .z = at[2]};
}

static void predict(double t, const double *gyro, const double *accel) {
  Axis3f w = {.x = gyro[0], .y = gyro[1], .z = gyro[2]}, f = {.x = accel[0], .y = accel[1], .z = accel[2]};
  kalmanCorePredict(&core, &params, &f, &w, (uint32_t)(1000.0 * t + 0.5), true);
}

int32_t tdoa_peer_version(void) { return 1; }

void tdoa_peer_start(const double *where, int32_t count, const double *p, const double *q) {
  anchors = where; started = 0;
  kalmanCoreDefaultParams(&params);
  params.initialYaw = 2 * atan2(q[2], q[3]);  /* level */
  params.initialX = p[0]; params.initialY = p[1]; params.initialZ = p[2];
  /* it flies already */
  params.stdDevInitialPosition_xy = params.stdDevInitialPosition_z = 0.3f;
  params.stdDevInitialVelocity = 1.0f;
  params.stdDevInitialAttitude_rollpitch = 0.2f;
  outlierFilterTdoaReset(&outliers);
}

void tdoa_peer_run(const tdoa_peer_event *e, int32_t count) {
  for (; count--; e++) {
    uint32_t now = (uint32_t)(1000.0 * e->t + 0.5);
    if (!started++) kalmanCoreInit(&core, &params, now);
    if (e->a < 0) {
      predict(e->t, e->gyro, e->accel);
      kalmanCoreAddProcessNoise(&core, &params, now);
    } else {
      tdoaMeasurement_t tdoa = {.anchorPositions = {place(e->a), place(e->b)}, .distanceDiff = e->d, .stdDev = 0.15f};
      if (ROBUST) kalmanCoreRobustUpdateWithTdoa(&core, &tdoa, &outliers);
      else kalmanCoreUpdateWithTdoa(&core, &tdoa, now, &outliers);
    }
    kalmanCoreFinalize(&core);
  }
}

void tdoa_peer_position(double *p) { for (int k = 0; k < 3; k++) p[k] = core.S[KC_STATE_X + k]; }
