// The same objective in Ceres: dense Schur complement, analytic derivatives, one thread.
//
//   bundle IN OUT ROWS MAX_ITERATIONS FUNCTION_TOLERANCE LAPACK
//
// IN and OUT are flat little-endian files of int64 and float64, see ceres_program.py. ROWS is 3 for the exact objective
// (u, v, depth excess), or 2 without the depth regulariser: Debian's Ceres has its Schur eliminator specialised for
// residuals of two rows, so that is its best case. FUNCTION_TOLERANCE below zero: run MAX_ITERATIONS whatever happens.

#include <ceres/ceres.h>
#include <time.h>

#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <vector>

namespace {

constexpr double kMinDepth = 1e-6;  // as MIN_DEPTH in improvo/backend/objective.py

using Vector3 = Eigen::Vector3d;
using Matrix3 = Eigen::Matrix3d;

Matrix3 Skew(const Vector3& v) {
  Matrix3 m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

Eigen::Quaterniond Exp(const Vector3& w) {
  const double angle = w.norm();
  const double share = angle > 1e-12 ? std::sin(0.5 * angle) / angle : 0.5;
  return {std::cos(0.5 * angle), share * w.x(), share * w.y(), share * w.z()};
}

// A pose is (quaternion x y z w, translation), perturbed from the left by (v, w). The cost function below already
// differentiates by (v, w), in the first six of its seven columns, hence the identity as Jacobian of Plus.
class PoseManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 6; }

  bool Plus(const double* x, const double* delta, double* y) const override {
    const Eigen::Quaterniond turn = Exp(Vector3(delta[3], delta[4], delta[5]));
    Eigen::Map<Eigen::Quaterniond> rotation(y);
    rotation = (turn * Eigen::Map<const Eigen::Quaterniond>(x)).normalized();
    Eigen::Map<Vector3>(y + 4) = turn * Eigen::Map<const Vector3>(x + 4) + Eigen::Map<const Vector3>(delta);
    return true;
  }

  bool PlusJacobian(const double*, double* jacobian) const override {
    Eigen::Map<Eigen::Matrix<double, 7, 6, Eigen::RowMajor>> J(jacobian);
    J.setZero();
    J.topRows<6>().setIdentity();
    return true;
  }

  bool Minus(const double* y, const double* x, double* delta) const override {
    const Eigen::AngleAxisd turn(Eigen::Map<const Eigen::Quaterniond>(y) *
                                 Eigen::Map<const Eigen::Quaterniond>(x).conjugate());
    const Vector3 w = turn.angle() * turn.axis();
    const Vector3 v = Eigen::Map<const Vector3>(y + 4) - turn * Eigen::Map<const Vector3>(x + 4);
    Vector3::Map(delta) = v;
    Vector3::Map(delta + 3) = w;
    return true;
  }

  bool MinusJacobian(const double*, double* jacobian) const override {
    Eigen::Map<Eigen::Matrix<double, 6, 7, Eigen::RowMajor>> J(jacobian);
    J.setZero();
    J.leftCols<6>().setIdentity();
    return true;
  }
};

double CpuSeconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

// Processor time from the end of iteration 0, the evaluation of the start, to the end of the latest one.
class Clock final : public ceres::IterationCallback {
 public:
  ceres::CallbackReturnType operator()(const ceres::IterationSummary& iteration) override {
    if (iteration.iteration == 0) start_ = CpuSeconds();
    seconds_ = CpuSeconds() - start_;
    return ceres::SOLVER_CONTINUE;
  }
  double seconds() const { return seconds_; }

 private:
  double start_ = 0.0, seconds_ = 0.0;
};

struct Objective {
  double fx, fy, cx, cy, huber_width, depth_min, depth_max, depth_weight;
};

template <int Rows>
class Observation final : public ceres::SizedCostFunction<Rows, 7, 3> {
 public:
  Observation(const Objective& objective, double u, double v) : objective_(objective), u_(u), v_(v) {}

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Matrix3 R = Eigen::Map<const Eigen::Quaterniond>(parameters[0]).toRotationMatrix();
    const Vector3 x = R * Eigen::Map<const Vector3>(parameters[1]) + Eigen::Map<const Vector3>(parameters[0] + 4);
    const double z = std::abs(x.z()) >= kMinDepth ? x.z() : std::copysign(kMinDepth, x.z());
    const double inverse = 1.0 / z;
    residuals[0] = objective_.fx * x.x() * inverse + objective_.cx - u_;
    residuals[1] = objective_.fy * x.y() * inverse + objective_.cy - v_;
    double excess = 0.0;
    if (x.z() > objective_.depth_max) excess = x.z() - objective_.depth_max;
    if (x.z() < objective_.depth_min) excess = x.z() - objective_.depth_min;
    const double scale = excess != 0.0 ? std::sqrt(objective_.depth_weight) : 0.0;
    if constexpr (Rows == 3) residuals[2] = scale * excess;
    if (jacobians == nullptr) return true;

    Eigen::Matrix<double, Rows, 3, Eigen::RowMajor> by_x;
    by_x.row(0) << objective_.fx * inverse, 0.0, -objective_.fx * x.x() * inverse * inverse;
    by_x.row(1) << 0.0, objective_.fy * inverse, -objective_.fy * x.y() * inverse * inverse;
    if constexpr (Rows == 3) by_x.row(2) << 0.0, 0.0, scale;
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, Rows, 7, Eigen::RowMajor>> J(jacobians[0]);
      J.template leftCols<3>() = by_x;
      J.template middleCols<3>(3).noalias() = -by_x * Skew(x);
      J.col(6).setZero();
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, Rows, 3, Eigen::RowMajor>> J(jacobians[1]);
      J.noalias() = by_x * R;
    }
    return true;
  }

 private:
  const Objective& objective_;
  double u_, v_;
};

template <typename T>
std::vector<T> Read(std::ifstream& file, int64_t count) {
  std::vector<T> values(count);
  file.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(T)));
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 7) {
    std::fprintf(stderr, "usage: bundle IN OUT ROWS MAX_ITERATIONS FUNCTION_TOLERANCE LAPACK\n");
    return 2;
  }
  google::InitGoogleLogging(argv[0]);
  const int rows = std::atoi(argv[3]);
  std::ifstream in(argv[1], std::ios::binary);
  const auto counts = Read<int64_t>(in, 3);  // cameras, points, observations
  const auto constants = Read<double>(in, 8);
  auto poses = Read<double>(in, 7 * counts[0]);
  auto points = Read<double>(in, 3 * counts[1]);
  const auto camera_index = Read<int64_t>(in, counts[2]);
  const auto point_index = Read<int64_t>(in, counts[2]);
  const auto keypoints = Read<double>(in, 2 * counts[2]);
  const auto weights = Read<double>(in, counts[2]);
  const auto fixed = Read<int64_t>(in, counts[0]);
  if (!in) {
    std::fprintf(stderr, "bundle: cannot read %s\n", argv[1]);
    return 2;
  }
  const Objective objective{constants[0], constants[1], constants[2], constants[3],
                            constants[4], constants[5], constants[6], constants[7]};

  ceres::Problem::Options problem_options;
  problem_options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  problem_options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  ceres::Problem problem(problem_options);
  PoseManifold manifold;
  ceres::HuberLoss huber(objective.huber_width);
  std::vector<std::unique_ptr<ceres::LossFunction>> scaled;
  auto* ordering = new ceres::ParameterBlockOrdering;
  for (int64_t camera = 0; camera < counts[0]; ++camera) problem.AddParameterBlock(&poses[7 * camera], 7, &manifold);
  for (int64_t point = 0; point < counts[1]; ++point) {
    problem.AddParameterBlock(&points[3 * point], 3);
    ordering->AddElementToGroup(&points[3 * point], 0);
  }
  for (int64_t camera = 0; camera < counts[0]; ++camera) {
    ordering->AddElementToGroup(&poses[7 * camera], 1);
    if (fixed[camera]) problem.SetParameterBlockConstant(&poses[7 * camera]);
  }
  for (int64_t o = 0; o < counts[2]; ++o) {
    ceres::LossFunction* loss = &huber;
    if (weights[o] != 1.0) {
      scaled.push_back(std::make_unique<ceres::ScaledLoss>(&huber, weights[o], ceres::DO_NOT_TAKE_OWNERSHIP));
      loss = scaled.back().get();
    }
    ceres::CostFunction* cost = nullptr;
    if (rows == 3) cost = new Observation<3>(objective, keypoints[2 * o], keypoints[2 * o + 1]);
    else cost = new Observation<2>(objective, keypoints[2 * o], keypoints[2 * o + 1]);
    problem.AddResidualBlock(cost, loss, &poses[7 * camera_index[o]], &points[3 * point_index[o]]);
  }

  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.dense_linear_algebra_library_type = std::atoi(argv[6]) ? ceres::LAPACK : ceres::EIGEN;
  options.linear_solver_ordering.reset(ordering);
  options.num_threads = 1;
  options.max_num_iterations = std::atoi(argv[4]);
  options.function_tolerance = std::atof(argv[5]);
  if (options.function_tolerance < 1e-6) {  // not Ceres' default: let nothing else stop it earlier either
    options.function_tolerance = std::max(options.function_tolerance, 0.0);
    options.gradient_tolerance = 0.0;
    options.parameter_tolerance = 0.0;
  }
  options.logging_type = ceres::SILENT;
  Clock clock;
  options.callbacks.push_back(&clock);
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);

  std::ofstream out(argv[2], std::ios::binary);
  out.write(reinterpret_cast<const char*>(poses.data()), static_cast<std::streamsize>(poses.size() * sizeof(double)));
  out.write(reinterpret_cast<const char*>(points.data()), static_cast<std::streamsize>(points.size() * sizeof(double)));
  std::printf(
      "{\"version\": \"%s\", \"iterations\": %d, \"rejected\": %d, \"converged\": %s, \"initial_cost\": %.17g, "
      "\"cost\": %.17g, \"threads\": %d, \"seconds\": %.9f, \"preprocess\": %.9f, \"residuals\": %.9f, "
      "\"jacobians\": %.9f, \"linear_solver\": %.9f}\n",
      CERES_VERSION_STRING, static_cast<int>(summary.iterations.size()) - 1, summary.num_unsuccessful_steps,
      summary.termination_type == ceres::CONVERGENCE ? "true" : "false", 2.0 * summary.initial_cost,
      2.0 * summary.final_cost, summary.num_threads_used, clock.seconds(), summary.preprocessor_time_in_seconds,
      summary.residual_evaluation_time_in_seconds,
      summary.jacobian_evaluation_time_in_seconds, summary.linear_solver_time_in_seconds);
  return 0;
}
