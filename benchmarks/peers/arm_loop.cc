// The closed loop of an arm as one writes it with Pinocchio: integral barrier (corrected reading), limited torque, momentum observer; the
// plant carries a load that the model does not know.  RK4, the runs shared out over threads.  State of a run: q, q', eta.
#include <cmath>
#include <thread>
#include <vector>

#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>

using Eigen::VectorXd;
using pinocchio::Data;
using pinocchio::Model;
using pinocchio::SE3;

// Rows of n numbers each, in this order.
enum Row { K1, K2, O, KF, LIMIT, Q0, QA, QW, QP, L0, LA, LW, LP, U0, UA, UW, UP, D0, DA, DW, DP, ROWS };

static Model arm(int n, const double *links, const double *tip, double load) {
  // A link: mass, centre (3), inertia about it (xx, yy, zz, xy, xz, yz), rotation (9, rows), position (3), axis (3), armature.
  Model model;
  model.gravity.linear() = Eigen::Map<const Eigen::Vector3d>(tip + 3);
  for (int i = 0; i < n; i++) {
    const double *x = links + 26 * i;
    Eigen::Matrix3d I, R;
    I << x[4], x[7], x[8], x[7], x[5], x[9], x[8], x[9], x[6];
    R << x[10], x[11], x[12], x[13], x[14], x[15], x[16], x[17], x[18];
    SE3 place(R, Eigen::Vector3d(x[19], x[20], x[21]));
    Eigen::Vector3d axis(x[22], x[23], x[24]);
    // An axis of the frame has a joint of its own, which is faster; as when Pinocchio reads a URDF.
    int joint = axis.x() == 1   ? model.addJoint(i, pinocchio::JointModelRX(), place, "j" + std::to_string(i))
                : axis.y() == 1 ? model.addJoint(i, pinocchio::JointModelRY(), place, "j" + std::to_string(i))
                : axis.z() == 1 ? model.addJoint(i, pinocchio::JointModelRZ(), place, "j" + std::to_string(i))
                                : model.addJoint(i, pinocchio::JointModelRevoluteUnaligned(axis), place, "j" + std::to_string(i));
    model.armature[i] = x[25];
    model.appendBodyToJoint(joint, pinocchio::Inertia(x[0], Eigen::Vector3d(x[1], x[2], x[3]), I), SE3::Identity());
  }
  if (load > 0) {
    pinocchio::Inertia point(load, Eigen::Map<const Eigen::Vector3d>(tip), Eigen::Matrix3d::Zero());
    model.appendBodyToJoint(n, point, SE3::Identity());
  }
  return model;
}

struct Loop {
  int n;
  const double *rows;
  const Model &plant, &model;
  Data truth, known;
  VectorXd q, v, eta, alpha, dalpha, slope, tau, f_hat, total;

  Loop(int n, const double *rows, const Model &plant, const Model &model)
      : n(n), rows(rows), plant(plant), model(model), truth(plant), known(model), q(n), v(n), eta(n), alpha(n), dalpha(n), slope(n), tau(n),
        f_hat(n), total(n) {}

  double row(Row r, int i) const { return rows[r * n + i]; }

  void rate(double t, const VectorXd &x, VectorXd &dx) {
    q = x.head(n), v = x.segment(n, n), eta = x.tail(n);
    for (int i = 0; i < n; i++) {
      auto wave = [&](Row o, Row a, Row w, Row p, double *y) {
        double s = std::sin(row(w, i) * t + row(p, i)), c = std::cos(row(w, i) * t + row(p, i));
        y[0] = row(o, i) + row(a, i) * s, y[1] = row(a, i) * row(w, i) * c, y[2] = -row(a, i) * row(w, i) * row(w, i) * s;
      };
      double r[3], lower[3], upper[3];
      wave(Q0, QA, QW, QP, r), wave(L0, LA, LW, LP, lower), wave(U0, UA, UW, UP, upper);
      double e1 = q[i] - r[0], below[3], above[3];
      for (int k = 0; k < 3; k++) below[k] = r[k] - lower[k], above[k] = upper[k] - r[k];
      double relative[2] = {below[1] / below[0], above[1] / above[0]};
      double change[2] = {below[2] / below[0] - relative[0] * relative[0], above[2] / above[0] - relative[1] * relative[1]};
      double kappa = std::sqrt(relative[0] * relative[0] + relative[1] * relative[1] + row(O, i));
      double dkappa = (relative[0] * change[0] + relative[1] * change[1]) / kappa;
      double k = e1 > 0 ? above[0] : below[0];
      alpha[i] = r[1] - (row(K1, i) + kappa) * e1;
      dalpha[i] = r[2] - (row(K1, i) + kappa) * (v[i] - r[1]) - dkappa * e1;
      slope[i] = 2 * e1 / (k * k - e1 * e1);
    }
    auto gain = [&](Row r) { return Eigen::Map<const VectorXd>(rows + r * n, n); };
    pinocchio::crba(model, known, q, pinocchio::Convention::WORLD);
    auto &M = known.M;
    M.triangularView<Eigen::StrictlyLower>() = M.transpose().triangularView<Eigen::StrictlyLower>();
    auto &C = pinocchio::computeCoriolisMatrix(model, known, q, v);
    auto &G = pinocchio::computeGeneralizedGravity(model, known, q);
    f_hat = eta + gain(KF).cwiseProduct(M * v);
    tau = C * alpha + G + M * dalpha - f_hat - gain(K2).cwiseProduct(v - alpha) - slope;
    tau = tau.cwiseMax(-gain(LIMIT)).cwiseMin(gain(LIMIT));
    for (int i = 0; i < n; i++) total[i] = tau[i] + row(D0, i) + row(DA, i) * std::sin(row(DW, i) * t + row(DP, i));
    dx.head(n) = v;
    dx.segment(n, n) = pinocchio::aba(plant, truth, q, v, total, pinocchio::Convention::WORLD);
    dx.tail(n) = -gain(KF).cwiseProduct(f_hat + tau + C.transpose() * v - G);
  }
};

extern "C" void arm_loop(int n, const double *links, const double *tip, double load, const double *rows, double *states, long runs, long steps,
                         double dt, long threads) {
  Model plant = arm(n, links, tip, load), model = arm(n, links, tip, 0);
  auto work = [&](long first, long last) {
    Loop loop(n, rows, plant, model);
    VectorXd x(3 * n), y(3 * n), k[4] = {y, y, y, y};
    for (long run = first; run < last; run++) {
      x = Eigen::Map<VectorXd>(states + 3 * n * run, 3 * n);
      for (long step = 0; step < steps; step++) {
        double t = step * dt;
        loop.rate(t, x, k[0]);
        loop.rate(t + dt / 2, y = x + dt / 2 * k[0], k[1]);
        loop.rate(t + dt / 2, y = x + dt / 2 * k[1], k[2]);
        loop.rate(t + dt, y = x + dt * k[2], k[3]);
        x += dt / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3]);
      }
      Eigen::Map<VectorXd>(states + 3 * n * run, 3 * n) = x;
    }
  };
  std::vector<std::thread> others;
  for (long i = 1; i < threads; i++) others.emplace_back(work, runs * i / threads, runs * (i + 1) / threads);
  work(0, runs / threads);
  for (auto &other : others) other.join();
}
