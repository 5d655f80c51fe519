/* Play a recorded flight to the Kalman filter of the Crazyflie firmware, with the correction of an export.

   replay ROBUST ENABLE STDDEV: kalman.robustTdoa, uwbBias.enable, and tdoa2.stddev, m.
   Standard input: struct begin, then struct event of the whole flight. Standard output: t and x, y, z, m, of the
   estimate after each TDOA, in double precision. It starts at the given position, at rest, level. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include "estimator_kalman.h"
#include "kalman_core.h"
#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
#include "outlierFilterTdoa.h"

#define PERIOD 0.01 /* s, of the predictions of the firmware */

typedef struct { double position[3], yaw; } begin;
typedef struct { double t, gyro[3], accel[3], d, a[3], b[3]; int32_t id_a, id_b; } event; /* id_a < 0: IMU */

extern uint8_t uwbBiasEnable; /* of uwb_bias_firmware.c */
static double now;
uint64_t usecTimestamp(void) { return (uint64_t)(1e6 * now); }
void assertFail(char *what, char *file, int line) { fprintf(stderr, "%s, %s:%d\n", what, file, line); abort(); }

static point_t place(const double *p) { return (point_t){.x = p[0], .y = p[1], .z = p[2]}; }

int main(int argc, char **argv) {
  static kalmanCoreData_t core;
  static OutlierFilterTdoaState_t outliers;
  kalmanCoreParams_t params;
  begin at;
  event e;
  double next = 0;
  int samples = 0;
  Axis3f rate = {0}, force = {0};
  if (argc != 4 || fread(&at, sizeof at, 1, stdin) != 1) return 1;
  const int robust = atoi(argv[1]);
  uwbBiasEnable = atoi(argv[2]);
  kalmanCoreDefaultParams(&params);
  params.initialX = at.position[0]; params.initialY = at.position[1]; params.initialZ = at.position[2];
  params.initialYaw = at.yaw;
  params.stdDevInitialPosition_xy = params.stdDevInitialPosition_z = 0.1f;
  params.stdDevInitialAttitude_yaw = 0.1f;
  outlierFilterTdoaReset(&outliers);
  while (fread(&e, sizeof e, 1, stdin) == 1) {
    const uint32_t ms = (uint32_t)(1000.0 * e.t + 0.5);
    now = e.t;
    if (next == 0) { kalmanCoreInit(&core, &params, ms); next = e.t + PERIOD; }
    if (e.id_a < 0) { /* the firmware predicts with the mean of the samples of a period */
      for (int k = 0; k < 3; k++) { rate.axis[k] += e.gyro[k]; force.axis[k] += e.accel[k]; }
      samples++;
      if (e.t >= next) {
        for (int k = 0; k < 3; k++) { rate.axis[k] /= samples; force.axis[k] /= samples; }
        kalmanCorePredict(&core, &params, &force, &rate, ms, true);
        next += PERIOD; samples = 0; rate = force = (Axis3f){0};
      }
      kalmanCoreAddProcessNoise(&core, &params, ms);
    } else {
      tdoaMeasurement_t tdoa = {.anchorPositions = {place(e.a), place(e.b)}, .distanceDiff = e.d,
                                .anchorIds = {e.id_a, e.id_b}, .stdDev = atof(argv[3])};
      if (robust) kalmanCoreRobustUpdateWithTdoa(&core, &tdoa, &outliers);
      else kalmanCoreUpdateWithTdoa(&core, &tdoa, ms, &outliers);
    }
    kalmanCoreFinalize(&core);
    if (e.id_a >= 0) {
      double out[4] = {e.t, core.S[KC_STATE_X], core.S[KC_STATE_Y], core.S[KC_STATE_Z]};
      fwrite(out, sizeof out, 1, stdout);
    }
  }
  return 0;
}
