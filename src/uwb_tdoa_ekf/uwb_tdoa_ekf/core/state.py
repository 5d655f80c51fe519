"""The nominal state, its error state, and their prediction with one IMU sample.

Nominal state x, (16,): position p (m) and velocity v (m/s) in the world, quaternion q (x y z w, body to world),
accelerometer bias (m/s^2) and gyroscope bias (rad/s) in the body frame. Error state, (15,), with covariance P:
[dp, dv, dtheta, dba, dbg], where the true attitude is q * Exp(dtheta), dtheta in the body frame.
Motion model: eq. 14 of Zhao et al. (RA-L 2021).
"""

import math

from uwb_tdoa_bias.foundation.compiled import compiled

GRAVITY = 9.81  # m/s^2, along -z of the world


@compiled
def rotation(x, R):
    """R (3, 3): body to world, from the quaternion in x."""
    qx, qy, qz, qw = x[6], x[7], x[8], x[9]
    R[0, 0] = 1 - 2 * (qy * qy + qz * qz)
    R[0, 1] = 2 * (qx * qy - qz * qw)
    R[0, 2] = 2 * (qx * qz + qy * qw)
    R[1, 0] = 2 * (qx * qy + qz * qw)
    R[1, 1] = 1 - 2 * (qx * qx + qz * qz)
    R[1, 2] = 2 * (qy * qz - qx * qw)
    R[2, 0] = 2 * (qx * qz - qy * qw)
    R[2, 1] = 2 * (qy * qz + qx * qw)
    R[2, 2] = 1 - 2 * (qx * qx + qy * qy)


@compiled
def turn(x, r0, r1, r2):
    """q <- q * Exp(r) for a rotation vector r (rad) in the body frame."""
    angle = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    bx, by, bz, bw = s * r0, s * r1, s * r2, math.cos(0.5 * angle)
    ax, ay, az, aw = x[6], x[7], x[8], x[9]
    qx = aw * bx + ax * bw + ay * bz - az * by
    qy = aw * by - ax * bz + ay * bw + az * bx
    qz = aw * bz + ax * by - ay * bx + az * bw
    qw = aw * bw - ax * bx - ay * by - az * bz
    n = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    x[6], x[7], x[8], x[9] = qx * n, qy * n, qz * n, qw * n


@compiled
def inject(x, K, gain):
    """Add the error K * gain, (15,), to the nominal state."""
    for j in range(6):
        x[j] += K[j] * gain
    turn(x, K[6] * gain, K[7] * gain, K[8] * gain)
    for j in range(9, 15):
        x[j + 1] += K[j] * gain


@compiled
def predict(x, P, F, R, E, step, dt, gyro, force, trust, accel_psd, gyro_psd, accel_walk_psd, gyro_walk_psd):
    """Advance state and covariance by dt seconds.

    gyro (3,) rad/s, force (3,) m/s^2: measured rates and specific force, held over dt; trust (3,): share of the
    measured specific force in what is used, per body axis (the rest is "hovering": gravity along body z);
    accel_psd, accel_walk_psd (3,) (m/s^2)^2/Hz and (m/s^3)^2/Hz; the other densities scalar, SI. F (15, 15): scratch;
    R, E (3, 3) and step (16,): scratch, which then holds what `propagate` needs to repeat the step.
    """
    rotation(x, R)
    f0 = trust[0] * (force[0] - x[10])
    f1 = trust[1] * (force[1] - x[11])
    f2 = GRAVITY + trust[2] * (force[2] - x[12] - GRAVITY)
    w0, w1, w2 = (gyro[0] - x[13]) * dt, (gyro[1] - x[14]) * dt, (gyro[2] - x[15]) * dt
    for r in range(3):
        a = R[r, 0] * f0 + R[r, 1] * f1 + R[r, 2] * f2 - (GRAVITY if r == 2 else 0.0)
        x[r] += dt * (x[3 + r] + 0.5 * dt * a)
        x[3 + r] += dt * a
    turn(x, w0, w1, w2)

    step[6] = step[7] = step[8] = 0.0
    step[9] = 1.0
    turn(step, -w0, -w1, -w2)
    rotation(step, E)
    step[0], step[1], step[2], step[3] = dt, f0, f1, f2
    step[10], step[11], step[12] = trust[0], trust[1], trust[2]
    propagate(P, F, R, E, step)
    for i in range(15):
        for j in range(i):
            F[i, j], F[j, i] = F[j, i], F[i, j]
    propagate(F, P, R, E, step)  # P is symmetric: Phi (Phi P)' = Phi P Phi'
    for r in range(3):
        for c in range(3):
            white = R[r, 0] * accel_psd[0] * R[c, 0] + R[r, 1] * accel_psd[1] * R[c, 1] + R[r, 2] * accel_psd[2] * R[c, 2]
            P[3 + r, 3 + c] += dt * white
        P[6 + r, 6 + r] += dt * gyro_psd
        P[9 + r, 9 + r] += dt * accel_walk_psd[r]
        P[12 + r, 12 + r] += dt * gyro_walk_psd
    for i in range(15):
        for j in range(i):
            P[i, j] = P[j, i]


@compiled
def propagate(A, out, R, E, step):
    """out <- Phi A for the transition Phi of the error state over one step; A, out: (15, 15).

    Only the blocks of Phi that differ from those of the identity are written out:
    dp' = dp + dv dt;  dv' = dv - R ([f]x dtheta + T dba) dt;  dtheta' = Exp(-w dt) dtheta - dbg dt.
    """
    dt, f0, f1, f2 = step[0], step[1], step[2], step[3]
    for j in range(15):
        t0, t1, t2 = A[6, j], A[7, j], A[8, j]
        c0 = f1 * t2 - f2 * t1 + step[10] * A[9, j]
        c1 = f2 * t0 - f0 * t2 + step[11] * A[10, j]
        c2 = f0 * t1 - f1 * t0 + step[12] * A[11, j]
        for r in range(3):
            out[r, j] = A[r, j] + dt * A[3 + r, j]
            out[3 + r, j] = A[3 + r, j] - dt * (R[r, 0] * c0 + R[r, 1] * c1 + R[r, 2] * c2)
            out[6 + r, j] = E[r, 0] * t0 + E[r, 1] * t1 + E[r, 2] * t2 - dt * A[12 + r, j]
        for r in range(9, 15):
            out[r, j] = A[r, j]


@compiled
def coast(x, P, dt, accel_psd, turn_psd):
    """Advance by dt seconds with no inertial sample: constant velocity with random acceleration, attitude held.

    accel_psd (m/s^2)^2/Hz; turn_psd (rad/s)^2/Hz, growth of the attitude's uncertainty.
    """
    for i in range(3):
        x[i] += dt * x[3 + i]
        for j in range(15):
            P[i, j] += dt * P[3 + i, j]
    for i in range(15):
        for j in range(3):
            P[i, j] += dt * P[i, 3 + j]
    for i in range(3):
        P[3 + i, 3 + i] += dt * accel_psd
        P[6 + i, 6 + i] += dt * turn_psd


@compiled
def difference(a, b, out):
    """Error state that leads from nominal state a to b, its first nine elements: out (9,) = [dp, dv, dtheta]."""
    for k in range(6):
        out[k] = b[k] - a[k]
    ax, ay, az, aw = -a[6], -a[7], -a[8], a[9]
    bx, by, bz, bw = b[6], b[7], b[8], b[9]
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    w = aw * bw - ax * bx - ay * by - az * bz
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    norm = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-9 else 2.0 * math.atan2(norm, w) / norm
    out[6], out[7], out[8] = scale * x, scale * y, scale * z
