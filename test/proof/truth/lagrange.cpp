// SPDX-License-Identifier: Apache-2.0
// Motions of the manipulator to some 30 of 33 digits, by Lagrange's equations.
//
// Coordinates are a Cayley vector x of the star's turn since the last step. Frames of all
// seven links are built by geometry from R(x), with their first and second derivatives by
// x (automatic differentiation); the mass matrix and its slopes follow from them, the
// generalized forces from the joint angles. Steps are those of Gragg, Bulirsch and Stoer.
// Contacts, clamps and the end of a pull are events: each mode is smooth, and a step ends
// where a mode does. Nothing here is taken from the package; the input is plain numbers.

#include <quadmath.h>

#include <array>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>
#include <string>
#include <vector>

typedef __float128 Real;
typedef std::vector<Real> State;

static Real LOCAL_ERROR = 1e-31Q;        // of a step; an argument replaces it
static const Real EVENT = 1e-30Q;        // an event is this near to zero
static const int AGAIN = -2;              // an event that needs a shorter step
static const int STAGES = 11;            // of the extrapolation: order 22
static const int SECOND[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

// A number with its first derivatives by x.
struct Slope {
  Real value = 0, by[3] = {0, 0, 0};
};

Slope operator+(Slope a, const Slope& b) {
  a.value += b.value;
  for (int i = 0; i < 3; ++i) a.by[i] += b.by[i];
  return a;
}

Slope operator*(const Slope& a, const Slope& b) {
  Slope c;
  c.value = a.value * b.value;
  for (int i = 0; i < 3; ++i) c.by[i] = a.value * b.by[i] + a.by[i] * b.value;
  return c;
}

Slope operator*(Real a, Slope b) {
  b.value *= a;
  for (Real& slope : b.by) slope *= a;
  return b;
}

// A number with its first and second derivatives by x.
struct Jet {
  Real value = 0, by[3] = {0, 0, 0}, second[6] = {0, 0, 0, 0, 0, 0};

  Jet(Real number = 0) : value(number) {}

  Slope number() const {
    Slope s;
    s.value = value;
    for (int i = 0; i < 3; ++i) s.by[i] = by[i];
    return s;
  }

  Slope derivative(int j) const {
    Slope s;
    s.value = by[j];
    for (int i = 0; i < 3; ++i) s.by[i] = second[SECOND[i][j]];
    return s;
  }
};

Jet operator+(Jet a, const Jet& b) {
  a.value += b.value;
  for (int i = 0; i < 3; ++i) a.by[i] += b.by[i];
  for (int i = 0; i < 6; ++i) a.second[i] += b.second[i];
  return a;
}

Jet operator*(Real a, Jet b) {
  b.value *= a;
  for (Real& slope : b.by) slope *= a;
  for (Real& curvature : b.second) curvature *= a;
  return b;
}

Jet operator-(const Jet& a, const Jet& b) { return a + Real(-1) * b; }

Jet operator*(const Jet& a, const Jet& b) {
  Jet c(a.value * b.value);
  for (int i = 0; i < 3; ++i) {
    c.by[i] = a.value * b.by[i] + a.by[i] * b.value;
    for (int j = i; j < 3; ++j) {
      int k = SECOND[i][j];
      c.second[k] = a.value * b.second[k] + a.second[k] * b.value +
                    a.by[i] * b.by[j] + a.by[j] * b.by[i];
    }
  }
  return c;
}

// f(a), from f and its first two derivatives at the value of a.
Jet apply(const Jet& a, Real f, Real first, Real second) {
  Jet c(f);
  for (int i = 0; i < 3; ++i) {
    c.by[i] = first * a.by[i];
    for (int j = i; j < 3; ++j) {
      int k = SECOND[i][j];
      c.second[k] = first * a.second[k] + second * a.by[i] * a.by[j];
    }
  }
  return c;
}

Jet inverse(const Jet& a) {
  Real r = 1 / a.value;
  return apply(a, r, -r * r, 2 * r * r * r);
}

Jet inverse_root(const Jet& a) {
  Real r = 1 / sqrtq(a.value);
  return apply(a, r, -r / (2 * a.value), 3 * r / (4 * a.value * a.value));
}

// The angle of (cosine, sine): that at the values, and the arctangent of what turns on.
Jet angle(const Jet& sine, const Jet& cosine) {
  Real at = atan2q(sine.value, cosine.value), c = cosq(at), s = sinq(at);
  Jet across = c * sine - s * cosine, along = c * cosine + s * sine;
  Jet turn = across * inverse(along);  // its value is zero, and so is atan'' there
  turn.value = at;
  return turn;
}

typedef std::array<Jet, 3> Vector;
typedef std::array<Vector, 3> Frame;  // columns
typedef std::array<Real, 3> Fixed;

Vector cross(const Vector& a, const Vector& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
          a[0] * b[1] - a[1] * b[0]};
}

Vector cross(const Fixed& a, const Vector& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
          a[0] * b[1] - a[1] * b[0]};
}

Jet dot(const Vector& a, const Vector& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

Jet dot(const Fixed& a, const Vector& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// All numbers of a manipulator, by name, as the input gives them.
struct Manipulator {
  std::map<std::string, std::vector<Real>> numbers;

  Real number(const std::string& name, size_t i = 0, Real other = 0) const {
    auto found = numbers.find(name);
    return found == numbers.end() ? other : found->second.at(i);
  }
  bool has(const std::string& name) const { return numbers.count(name) > 0; }
  Fixed fixed(const std::string& name, int leg) const {
    const std::vector<Real>& all = numbers.at(name);
    return {all[3 * leg], all[3 * leg + 1], all[3 * leg + 2]};
  }
};

// Which side of each kink a motion is on.
struct Mode {
  int contact[3] = {0, 0, 0};  // -1 at gamma = 0, 1 at the arc
  int pushes[3] = {1, 1, 1};   // 0 where the damping would pull
  int clamp[3] = {0, 0, 0};    // sign of a torque at its limit
};

struct Posture {
  Frame frames[7];  // star, {11} {12} {13}, {21} {22} {23}
  Jet joints[3][3];  // gamma, mu, beta by leg
};

// Frames and joint angles of the star at base times the Cayley vector x.
Posture posture(const Manipulator& m, const Real base[4], const Real x[3]) {
  Jet turn[4];
  for (int i = 0; i < 3; ++i) {
    turn[i] = Jet(x[i] / 2);
    turn[i].by[i] = 0.5Q;
  }
  turn[3] = Jet(1);
  Jet square = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] + turn[3];
  Jet length = inverse_root(square);
  for (Jet& part : turn) part = part * length;
  Real bx = base[0], by = base[1], bz = base[2], bw = base[3];
  Jet qx = bw * turn[0] + bx * turn[3] + by * turn[2] - bz * turn[1];
  Jet qy = bw * turn[1] + by * turn[3] + bz * turn[0] - bx * turn[2];
  Jet qz = bw * turn[2] + bz * turn[3] + bx * turn[1] - by * turn[0];
  Jet qw = bw * turn[3] - bx * turn[0] - by * turn[1] - bz * turn[2];
  Jet xx = qx * qx, yy = qy * qy, zz = qz * qz, xy = qx * qy, xz = qx * qz;
  Jet yz = qy * qz, wx = qw * qx, wy = qw * qy, wz = qw * qz;
  Jet one(1);
  Posture p;
  p.frames[0] = {{{one - 2 * (yy + zz), 2 * (xy + wz), 2 * (xz - wy)},
                  {2 * (xy - wz), one - 2 * (xx + zz), 2 * (yz + wx)},
                  {2 * (xz + wy), 2 * (yz - wx), one - 2 * (xx + yy)}}};
  const Frame& star = p.frames[0];
  const Vector& s = star[2];
  for (int k = 0; k < 3; ++k) {
    Fixed v = m.fixed("v", k), w = m.fixed("w", k), e = m.fixed("e", k);
    Fixed across = {w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2],
                    w[0] * v[1] - w[1] * v[0]};
    Vector t, normal, r, axis;
    for (int i = 0; i < 3; ++i) t[i] = e[0] * star[0][i] + e[1] * star[1][i];
    for (int i = 0; i < 3; ++i) axis[i] = Jet(w[i]);
    normal = cross(t, axis);
    Jet scale = inverse_root(dot(normal, normal));
    for (int i = 0; i < 3; ++i) r[i] = normal[i] * scale;
    p.frames[1 + k] = {r, cross(w, r), axis};
    p.frames[4 + k] = {r, cross(t, r), t};
    p.joints[0][k] = angle(dot(across, r), dot(v, r));
    Jet turned = dot(w, cross(r, t));  // (w x t) . -r, as mu turns w into t about -r
    p.joints[1][k] = angle(turned, dot(w, t));
    p.joints[2][k] = angle(dot(r, cross(t, s)), dot(r, s));
  }
  return p;
}

struct Body {
  Real inertia[3][3], weight[3];  // mass times centre
};

std::vector<Body> bodies(const Manipulator& m) {
  std::vector<Body> all(7);
  const std::vector<Real>& inertias = m.numbers.at("inertias");
  const std::vector<Real>& weights = m.numbers.at("weights");
  for (int b = 0; b < 7; ++b) {
    const Real* i = &inertias[6 * b];  // xx yy zz xy xz yz
    Real rows[3][3] = {{i[0], i[3], i[4]}, {i[3], i[1], i[5]}, {i[4], i[5], i[2]}};
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) all[b].inertia[r][c] = rows[r][c];
      all[b].weight[r] = weights[3 * b + r];
    }
  }
  return all;
}

Real commanded(const Manipulator& m, int leg, Real t) {
  Real torque = m.number("constant", leg);
  if (m.has("amplitude"))
    torque += m.number("amplitude", leg) *
              sinq(m.number("frequency", leg) * t + m.number("phase", leg));
  return torque;
}

Real rubbing(const Manipulator& m, int kind, Real rate) {
  std::string name = "friction" + std::to_string(kind);
  if (!m.has(name)) return 0;
  const std::vector<Real>& f = m.numbers.at(name);
  Real level = f[1];  // viscous, coulomb, smoothing, static, stribeck
  if (f[3] != 0) level += (f[3] - f[1]) * expq(-(rate / f[4]) * (rate / f[4]));
  return f[0] * rate + level * tanhq(rate / f[2]);
}

void solve(Real a[3][3], Real b[3]) {  // Gauss with pivots; the result is in b
  for (int c = 0; c < 3; ++c) {
    int best = c;
    for (int r = c; r < 3; ++r)
      if (fabsq(a[r][c]) > fabsq(a[best][c])) best = r;
    for (int k = 0; k < 3; ++k) std::swap(a[c][k], a[best][k]);
    std::swap(b[c], b[best]);
    for (int r = c + 1; r < 3; ++r) {
      Real factor = a[r][c] / a[c][c];
      for (int k = c; k < 3; ++k) a[r][k] -= factor * a[c][k];
      b[r] -= factor * b[c];
    }
  }
  for (int c = 2; c >= 0; --c) {
    for (int k = c + 1; k < 3; ++k) b[c] -= a[c][k] * b[k];
    b[c] /= a[c][c];
  }
}

struct Motion {
  Manipulator m;
  std::vector<Body> masses;
  Mode mode;
  Real base[4];

  // State: x, dx/dt, and with a lag the torques of the actuators.
  State derivative(Real t, const State& y) const {
    Posture p = posture(m, base, &y[0]);
    const Real* rate = &y[3];
    Slope mass[3][3];
    Real force[3] = {0, 0, 0};
    for (int b = 0; b < 7; ++b) {
      if (b == 1 || b == 2 || b == 3) continue;
      add_body(p.frames[b], masses[b], mass, force);
    }
    for (int k = 0; k < 3; ++k) add_drive(p, k, mass, force);
    // d/dt (M x') - d/dx (x' M x') / 2
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) {
          force[i] -= mass[i][j].by[k] * rate[k] * rate[j];
          force[i] += mass[j][k].by[i] * rate[j] * rate[k] / 2;
        }
    if (m.has("moment")) add_moment(p.frames[0], force);
    Real drive[3];
    for (int leg = 0; leg < 3; ++leg) {
      Real torque = commanded(m, leg, t);
      if (mode.clamp[leg] != 0) torque = mode.clamp[leg] * m.number("torque_limit");
      drive[leg] = torque;
    }
    State slope(y.size());
    if (m.has("time_constant"))
      for (int leg = 0; leg < 3; ++leg) {
        slope[6 + leg] = (drive[leg] - y[6 + leg]) / m.number("time_constant");
        drive[leg] = y[6 + leg];
      }
    for (int kind = 0; kind < 3; ++kind)
      for (int leg = 0; leg < 3; ++leg) {
        const Jet& joint = p.joints[kind][leg];
        Real speed = 0;
        for (int i = 0; i < 3; ++i) speed += joint.by[i] * rate[i];
        Real torque = -rubbing(m, kind, speed);
        if (kind == 0) torque += drive[leg] + stop_torque(leg, joint.value, speed);
        if (m.has("stiffness")) {
          int number = 3 * kind + leg;
          Real stretch = joint.value - m.number("rest", number);
          torque -= m.number("stiffness", number) * stretch;
        }
        for (int i = 0; i < 3; ++i) force[i] += torque * joint.by[i];
      }
    Real matrix[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) matrix[i][j] = mass[i][j].value;
    solve(matrix, force);
    for (int i = 0; i < 3; ++i) {
      slope[i] = rate[i];
      slope[3 + i] = force[i];
    }
    return slope;
  }

  // Angular velocity per dx/dt in the frame: the vector of F^T dF/dx_j.
  void add_body(const Frame& f, const Body& body, Slope mass[3][3],
                Real force[3]) const {
    Slope spin[3][3];  // by x_j, component
    for (int j = 0; j < 3; ++j)
      for (int c = 0; c < 3; ++c) {
        const Vector& along = f[(c + 2) % 3];
        const Vector& moved = f[(c + 1) % 3];
        for (int i = 0; i < 3; ++i)
          spin[j][c] = spin[j][c] + along[i].number() * moved[i].derivative(j);
      }
    for (int j = 0; j < 3; ++j)
      for (int r = 0; r < 3; ++r) {
        Slope momentum;
        for (int c = 0; c < 3; ++c)
          if (body.inertia[r][c] != 0)
            momentum = momentum + body.inertia[r][c] * spin[j][c];
        for (int i = 0; i < 3; ++i)
          mass[i][j] = mass[i][j] + spin[i][r] * momentum;
      }
    if (m.has("gravity")) add_weight(f, body, force);
  }

  void add_weight(const Frame& f, const Body& body, Real force[3]) const {
    for (int i = 0; i < 3; ++i)
      for (int axis = 0; axis < 3; ++axis)
        for (int c = 0; c < 3; ++c)
          force[i] += m.number("gravity", axis) * f[c][axis].by[i] * body.weight[c];
  }

  // An actuated link turns about its own axis z alone.
  void add_drive(const Posture& p, int leg, Slope mass[3][3], Real force[3]) const {
    const Body& body = masses[1 + leg];
    const Jet& gamma = p.joints[0][leg];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        mass[i][j] = mass[i][j] + body.inertia[2][2] * (gamma.derivative(i) *
                                                        gamma.derivative(j));
    if (m.has("gravity")) add_weight(p.frames[1 + leg], body, force);
  }

  void add_moment(const Frame& f, Real force[3]) const {
    for (int j = 0; j < 3; ++j)
      for (int c = 0; c < 3; ++c) {
        Real spin = 0, along = 0;
        for (int i = 0; i < 3; ++i) {
          spin += f[(c + 2) % 3][i].value * f[(c + 1) % 3][i].by[j];
          along += f[c][i].value * m.number("moment", i);
        }
        force[j] += spin * along;
      }
  }

  Real stop_torque(int leg, Real gamma, Real speed) const {
    int side = mode.contact[leg];
    if (side == 0 || !mode.pushes[leg]) return 0;
    Real depth = side < 0 ? -gamma : gamma - m.number("arc", leg);
    Real inward = side * speed;
    return -side * m.number("stop_stiffness") * depth *
           (1 + m.number("stop_damping") * inward);
  }

  // Numbers that are positive in the mode, in an order that `flip` knows.
  std::vector<Real> gauges(Real t, const State& y) const {
    std::vector<Real> all;
    Posture p;
    bool stops = m.has("stop_stiffness"), limited = m.has("torque_limit");
    if (stops) p = posture(m, base, &y[0]);
    for (int leg = 0; leg < 3 && stops; ++leg) {
      const Jet& gamma = p.joints[0][leg];
      Real speed = 0, arc = m.number("arc", leg);
      for (int i = 0; i < 3; ++i) speed += gamma.by[i] * y[3 + i];
      int side = mode.contact[leg];
      all.push_back(side < 0 ? -gamma.value : gamma.value);
      all.push_back(side > 0 ? gamma.value - arc : arc - gamma.value);
      Real push = 1 + m.number("stop_damping") * side * speed;
      all.push_back(side == 0 ? Real(1) : (mode.pushes[leg] ? push : -push));
    }
    for (int leg = 0; leg < 3 && limited; ++leg) {
      Real torque = commanded(m, leg, t), most = m.number("torque_limit");
      int side = mode.clamp[leg];
      all.push_back(side < 0 ? -most - torque : torque + most);
      all.push_back(side > 0 ? torque - most : most - torque);
    }
    return all;
  }

  void flip(int index) {
    int stops = m.has("stop_stiffness") ? 9 : 0;
    if (index < stops) {
      int leg = index / 3, kind = index % 3;
      if (kind == 2) {
        mode.pushes[leg] = !mode.pushes[leg];
      } else {
        int side = kind == 0 ? -1 : 1;
        mode.contact[leg] = mode.contact[leg] == side ? 0 : side;
        mode.pushes[leg] = 1;
      }
      return;
    }
    int leg = (index - stops) / 2, side = (index - stops) % 2 == 0 ? -1 : 1;
    mode.clamp[leg] = mode.clamp[leg] == side ? 0 : side;
  }

  // The end of a step of length h by extrapolation, and its error.
  State extrapolate(Real t, const State& y, Real h, Real* error) const {
    size_t n = y.size();
    State first = derivative(t, y);
    std::vector<State> before;
    for (int stage = 1; stage <= STAGES; ++stage) {
      int count = 2 * stage;
      Real small = h / count;
      State old = y, here(n);
      for (size_t i = 0; i < n; ++i) here[i] = y[i] + small * first[i];
      for (int k = 1; k < count; ++k) {
        State slope = derivative(t + k * small, here);
        for (size_t i = 0; i < n; ++i) {
          Real next = old[i] + 2 * small * slope[i];
          old[i] = here[i];
          here[i] = next;
        }
      }
      State last = derivative(t + h, here);
      std::vector<State> row(1, State(n));
      for (size_t i = 0; i < n; ++i)
        row[0][i] = (here[i] + old[i] + small * last[i]) / 2;
      for (size_t k = 0; k < before.size(); ++k) {
        Real ratio = Real(count) / (count - 2 * int(k + 1));
        State next(n);
        for (size_t i = 0; i < n; ++i)
          next[i] = row[k][i] + (row[k][i] - before[k][i]) / (ratio * ratio - 1);
        row.push_back(next);
      }
      before = row;
    }
    *error = 0;
    for (size_t i = 0; i < n; ++i) {
      Real off = fabsq(before[STAGES - 1][i] - before[STAGES - 2][i]);
      *error = fmaxq(*error, off / (1 + fabsq(y[i])));
    }
    return before[STAGES - 1];
  }

  // The first gauge below zero at the end of a step, by the time where it passes zero.
  int first_event(Real t, const State& y, Real h, const State& end, Real* at) const {
    std::vector<Real> begin = gauges(t, y), last = gauges(t + h, end);
    int which = -1;
    *at = h;
    for (size_t i = 0; i < last.size(); ++i) {
      if (last[i] >= 0) continue;
      if (begin[i] <= 2 * EVENT) return AGAIN;  // it was zero and is passed once more
      Real low = 0, high = h, above = begin[i], below = last[i], middle = h;
      for (int turn = 0; turn < 80 && high - low > 0; ++turn) {
        middle = low + (high - low) * above / (above - below);
        if (turn % 4 == 3) middle = (low + high) / 2;
        Real unused;
        Real value = gauges(t + middle, extrapolate(t, y, middle, &unused))[i];
        if (fabsq(value) < EVENT) break;
        if (value > 0) {
          low = middle;
          above = value;
        } else {
          high = middle;
          below = value;
        }
      }
      if (middle < *at || which < 0) {
        *at = middle;
        which = int(i);
      }
    }
    return which;
  }

  // Take x as a turn of the base, so that it is zero again.
  void rebase(State& y) {
    Posture p = posture(m, base, &y[0]);
    Real spin[3] = {0, 0, 0};
    const Frame& f = p.frames[0];
    for (int c = 0; c < 3; ++c)
      for (int j = 0; j < 3; ++j)
        for (int i = 0; i < 3; ++i)
          spin[c] += f[(c + 2) % 3][i].value * f[(c + 1) % 3][i].by[j] * y[3 + j];
    Real tx = y[0] / 2, ty = y[1] / 2, tz = y[2] / 2;
    Real bx = base[0], by = base[1], bz = base[2], bw = base[3];
    Real q[4] = {bw * tx + bx + by * tz - bz * ty, bw * ty + by + bz * tx - bx * tz,
                 bw * tz + bz + bx * ty - by * tx, bw - bx * tx - by * ty - bz * tz};
    Real length = sqrtq(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; ++i) base[i] = q[i] / length;
    for (int i = 0; i < 3; ++i) {
      y[i] = 0;
      y[3 + i] = spin[i];
    }
  }

  // The state at gamma and gamma_dot, by Newton's method on the joint angles.
  State start() {
    Real length = 0;
    for (int i = 0; i < 4; ++i) {
      base[i] = m.number("near", i);
      length += base[i] * base[i];
    }
    for (Real& part : base) part /= sqrtq(length);
    State y(m.has("time_constant") ? 9 : 6);
    for (int turn = 0; turn < 12; ++turn) {
      Posture p = posture(m, base, &y[0]);
      Real matrix[3][3], gap[3];
      for (int leg = 0; leg < 3; ++leg) {
        gap[leg] = m.number("gamma", leg) - p.joints[0][leg].value;
        for (int i = 0; i < 3; ++i) matrix[leg][i] = p.joints[0][leg].by[i];
      }
      solve(matrix, gap);
      for (int i = 0; i < 3; ++i) y[i] += gap[i];
      rebase(y);
    }
    Posture p = posture(m, base, &y[0]);
    Real matrix[3][3], rate[3];
    for (int leg = 0; leg < 3; ++leg) {
      rate[leg] = m.number("gamma_dot", leg);
      for (int i = 0; i < 3; ++i) matrix[leg][i] = p.joints[0][leg].by[i];
    }
    solve(matrix, rate);
    for (int i = 0; i < 3; ++i) y[3 + i] = rate[i];
    return y;
  }

  void print(const State& y) const {
    Posture p = posture(m, base, &y[0]);
    State moved = y;
    Motion here = *this;
    here.rebase(moved);
    for (int i = 0; i < 4; ++i) write(here.base[i]);
    for (int i = 0; i < 3; ++i) write(moved[3 + i]);
    for (int kind = 0; kind < 3; ++kind)
      for (int leg = 0; leg < 3; ++leg) write(p.joints[kind][leg].value);
    for (int kind = 0; kind < 3; ++kind)
      for (int leg = 0; leg < 3; ++leg) {
        Real speed = 0;
        for (int i = 0; i < 3; ++i) speed += p.joints[kind][leg].by[i] * y[3 + i];
        write(speed);
      }
    std::printf("\n");
  }

  static void write(Real x) {
    char text[64];
    quadmath_snprintf(text, sizeof text, "%.36Qe", x);
    std::printf("%s ", text);
  }

  void run() {
    State y = start();
    Real t = 0, h = 0.01Q;
    if (m.has("longest")) h = m.number("longest");
    const Real longest = m.number("longest", 0, 0.1Q);
    for (int i = 0; i < 12; ++i) {  // the modes that the start is in
      std::vector<Real> all = gauges(t, y);
      for (size_t k = 0; k < all.size(); ++k)
        if (all[k] < 0) {
          flip(int(k));
          break;
        }
    }
    for (Real end : m.numbers.at("times")) {
      while (t < end) {
        if (h > longest) h = longest;
        bool last = t + h >= end;
        Real step = last ? end - t : h, error;
        State next = extrapolate(t, y, step, &error);
        Real grow = error > 0 ? 0.8Q * powq(LOCAL_ERROR / error, 1.0Q / 21) : 2;
        if (error > LOCAL_ERROR) {
          h = step * fmaxq(grow, 0.2Q);
          if (h < 1e-9Q) std::exit(3);
          continue;
        }
        Real at;
        int event = first_event(t, y, step, next, &at);
        if (event == AGAIN) {
          h = step / 3;
          if (h < 1e-9Q) std::exit(4);
          continue;
        }
        if (event >= 0) {
          Real unused;
          y = extrapolate(t, y, at, &unused);
          t += at;
          flip(event);
          char when[64];
          quadmath_snprintf(when, sizeof when, "%.36Qe", t);
          std::fprintf(stderr, "%d %s\n", event, when);
        } else {
          y = next;
          t = last ? end : t + step;
          if (!last) h = step * fminq(grow, 2);
        }
        rebase(y);
      }
      print(y);
    }
  }
};

int main(int count, char** words) {
  if (count > 1) LOCAL_ERROR = strtoflt128(words[1], nullptr);
  Motion motion;
  std::string line;
  while (std::getline(std::cin, line)) {
    size_t at = line.find(' ');
    std::vector<Real>& row = motion.m.numbers[line.substr(0, at)];
    while (at < line.size()) {
      size_t next = line.find(' ', at + 1);
      row.push_back(strtoflt128(line.substr(at + 1, next - at - 1).c_str(), nullptr));
      at = next;
    }
  }
  motion.masses = bodies(motion.m);
  motion.run();
  return 0;
}
