// SPDX-License-Identifier: Apache-2.0
// Pinocchio without Python: the mechanism, its constrained dynamics, Runge-Kutta steps.
// benchmark/peers/pinocchio_peer.py compiles this file and calls it by ctypes.

#include <pinocchio/algorithm/constrained-dynamics.hpp>

#include <cmath>
#include <memory>
#include <string>
#include <vector>

namespace pin = pinocchio;
using Eigen::Map;
using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::VectorXd;
using Rows = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

struct Engine {
  pin::Model model;
  std::unique_ptr<pin::Data> data;
  std::vector<pin::RigidConstraintModel> ties;
  std::vector<pin::RigidConstraintData> tied;
  pin::ProximalSettings proximal;
};

extern "C" {

// Joints are numbered from 1, parents before children; 0 is the base.
Engine *make(long bodies, const long *parents, const double *axes, const double *masses,
             const double *centres, const double *tensors, long ties, const long *pairs,
             const double *points, double mu, long iterations) {
  auto *engine = new Engine;
  pin::Model &model = engine->model;
  model.gravity = pin::Motion::Zero();
  const pin::SE3 still = pin::SE3::Identity();
  for (long i = 0; i < bodies; i++) {
    const Vector3d axis = Map<const Vector3d>(axes + 3 * i);
    const auto joint = model.addJoint(parents[i], pin::JointModelRevoluteUnaligned(axis),
                                      still, "joint" + std::to_string(i));
    const Vector3d centre = Map<const Vector3d>(centres + 3 * i);
    const Matrix3d tensor = Map<const Rows>(tensors + 9 * i);
    model.appendBodyToJoint(joint, pin::Inertia(masses[i], centre, tensor), still);
  }
  for (long i = 0; i < ties; i++) {
    pin::SE3 place = still;
    place.translation() = Map<const Vector3d>(points + 3 * i);
    engine->ties.emplace_back(pin::CONTACT_3D, model, pairs[2 * i], place,
                              pairs[2 * i + 1], place);
  }
  for (const auto &tie : engine->ties) engine->tied.emplace_back(tie);
  engine->data = std::make_unique<pin::Data>(model);
  pin::initConstraintDynamics(model, *engine->data, engine->ties, engine->tied);
  engine->proximal = pin::ProximalSettings(1e-16, mu, iterations);
  return engine;
}

// Accelerations of the joints at angles q and rates v under torques.
void accelerate(Engine *engine, const double *q, const double *v, const double *torque,
                double *result) {
  const long n = engine->model.nv;
  Map<VectorXd>(result, n) = pin::constraintDynamics(
      engine->model, *engine->data, Map<const VectorXd>(q, n), Map<const VectorXd>(v, n),
      Map<const VectorXd>(torque, n), engine->ties, engine->tied, engine->proximal);
}

// Steps of an explicit method over a duration, x = (q, v) in place. The torques are
// amplitude * sin(frequency * t + phase) at the joints `drives`; rows of `a` are padded.
void run(Engine *engine, long stages, const double *a, const double *b, const double *c,
         long steps, double duration, const long *drives, const double *sines, double *x) {
  const long n = engine->model.nv;
  const double h = duration / steps;
  Map<VectorXd> state(x, 2 * n);
  VectorXd at(2 * n), force = VectorXd::Zero(n), q(n), v(n);
  Eigen::MatrixXd slopes(2 * n, stages);
  for (long step = 0; step < steps; step++) {
    for (long stage = 0; stage < stages; stage++) {
      at = state;
      for (long k = 0; k < stage; k++) {
        const double weight = a[stages * stage + k];
        if (weight != 0.0) at += (h * weight) * slopes.col(k);
      }
      const double t = step * h + h * c[stage];
      for (long k = 0; k < 3; k++)
        force[drives[k]] = sines[3 * k] * std::sin(sines[3 * k + 1] * t + sines[3 * k + 2]);
      q = at.head(n);
      v = at.tail(n);
      slopes.col(stage).head(n) = v;
      slopes.col(stage).tail(n) =
          pin::constraintDynamics(engine->model, *engine->data, q, v, force, engine->ties,
                                  engine->tied, engine->proximal);
    }
    for (long k = 0; k < stages; k++) state += (h * b[k]) * slopes.col(k);
  }
}

}
