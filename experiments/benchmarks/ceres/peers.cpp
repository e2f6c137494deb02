// The joint problem of jaxcal with given SDs, solved one by one on one thread by Ceres and by its
// TinySolver.
//
// Per image i, with q_i = X^-1 B_i^-1 c the target in its frame and (x_i, r_i) what was measured:
//     minimise over X, c   sum_i ((q_x - x_i) / s_x)^2 + ((|(q_y, q_z)| - r_i) / s_r)^2
//                                + (q_y / s_y)^2.
// X steps by the right perturbation about its current value, X Exp([v, omega]) with Exp's
// translation taken as v, as in jaxcal.
//
// usage: ceres_peers PROBLEMS RESULTS SOLVER TOLERANCE REPEATS
// PROBLEMS: binary float64, see read_problems. SOLVER: schur | normal
// | tiny.
// RESULTS: per problem X (12, row-major 3x4), c (3), cost, iterations; then REPEATS seconds.

#include <ceres/ceres.h>
#include <ceres/tiny_solver.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

using Mat3 = Eigen::Matrix3d;
using Vec3 = Eigen::Vector3d;

struct Image {
  Mat3 rotation;  // B_i
  Vec3 translation;
  double lateral, range;
};

using Weights = Vec3;  // 1 / SD of lateral position, range and offset

// X as quaternion (x y z w, Eigen's order) and translation.
struct Problem {
  std::vector<Image> images;
  Eigen::Quaterniond rotation;
  Vec3 translation, point;
};

struct Solution {
  Eigen::Matrix<double, 7, 1> pose;
  Vec3 point;
  double cost = 0;
  int iterations = 0;
};

// exp of a rotation vector as a quaternion, without division at 0.
inline Eigen::Quaterniond quaternion_exp(const Vec3& turn) {
  const double angle = turn.norm();
  const double half = 0.5 * angle;
  const double scale = angle > 1e-8 ? std::sin(half) / angle : 0.5 - angle * angle / 48;
  return {std::cos(half), scale * turn.x(), scale * turn.y(), scale * turn.z()};
}

inline Mat3 skew(const Vec3& a) {
  Mat3 out;
  out << 0, -a.z(), a.y(), a.z(), 0, -a.x(), -a.y(), a.x(), 0;
  return out;
}

// Residuals of an image and their derivatives by q.
inline Vec3 residual_of(const Image& image, const Weights& weights, const Vec3& q, Mat3* slope) {
  const double far = std::hypot(q.y(), q.z());
  if (slope != nullptr) {
    *slope << weights.x(), 0, 0, 0, weights.y() * q.y() / far, weights.y() * q.z() / far, 0,
        weights.z(), 0;
  }
  return weights.cwiseProduct(Vec3(q.x() - image.lateral, far - image.range, q.y()));
}

// The pose moves on its manifold. Costs give their Jacobian along the tangent in the first six
// columns, so the manifold's own is a selection: Ceres then has no chain rule to compute.
class PoseManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 6; }
  bool Plus(const double* x, const double* delta, double* out) const override {
    Eigen::Map<const Eigen::Quaterniond> rotation(x);
    Eigen::Map<const Vec3> translation(x + 4), shift(delta), turn(delta + 3);
    Eigen::Map<Eigen::Quaterniond> new_rotation(out);
    Eigen::Map<Vec3> new_translation(out + 4);
    new_translation = translation + rotation * shift;
    new_rotation = (rotation * quaternion_exp(turn)).normalized();
    return true;
  }
  bool PlusJacobian(const double*, double* jacobian) const override {
    Eigen::Map<Eigen::Matrix<double, 7, 6, Eigen::RowMajor>> out(jacobian);
    out.setZero();
    out.topRows<6>().setIdentity();
    return true;
  }
  bool Minus(const double*, const double*, double*) const override { return false; }
  bool MinusJacobian(const double*, double*) const override { return false; }
};

// Residuals of one image and their derivatives along v, omega and c.
class ImageCost final : public ceres::SizedCostFunction<3, 7, 3> {
 public:
  ImageCost(const Image& image, const Weights& weights) : image_(image), weights_(weights) {}
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    Eigen::Map<const Eigen::Quaterniond> rotation(parameters[0]);
    Eigen::Map<const Vec3> translation(parameters[0] + 4), point(parameters[1]);
    const Mat3 turn = rotation.toRotationMatrix();
    const Vec3 probe = image_.rotation.transpose() * (point - image_.translation) - translation;
    const Vec3 q = turn.transpose() * probe;
    Mat3 slope;
    Eigen::Map<Vec3> r(residuals);
    r = residual_of(image_, weights_, q, jacobians == nullptr ? nullptr : &slope);
    if (jacobians == nullptr) return true;
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 3, 7, Eigen::RowMajor>> j(jacobians[0]);
      j.leftCols<3>() = -slope;
      j.middleCols<3>(3) = slope * skew(q);
      j.col(6).setZero();
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> j(jacobians[1]);
      j = slope * (turn.transpose() * image_.rotation.transpose());
    }
    return true;
  }

 private:
  const Image& image_;
  const Weights& weights_;
};

Solution solve_ceres(const Problem& problem, const Weights& weights, double tolerance,
                     ceres::LinearSolverType linear) {
  Solution out;
  out.pose << problem.rotation.coeffs(), problem.translation;
  out.point = problem.point;
  ceres::Problem ceres_problem;
  ceres_problem.AddParameterBlock(out.pose.data(), 7, new PoseManifold);
  ceres_problem.AddParameterBlock(out.point.data(), 3);
  for (const Image& image : problem.images) {
    ceres_problem.AddResidualBlock(new ImageCost(image, weights), nullptr, out.pose.data(),
                                   out.point.data());
  }
  ceres::Solver::Options options;
  options.linear_solver_type = linear;
  if (linear == ceres::DENSE_SCHUR) {
    auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
    ordering->AddElementToGroup(out.point.data(), 0);
    ordering->AddElementToGroup(out.pose.data(), 1);
    options.linear_solver_ordering = ordering;
  }
  options.num_threads = 1;
  options.function_tolerance = tolerance;
  options.gradient_tolerance = 1e-300;
  options.parameter_tolerance = 1e-300;
  options.max_num_iterations = 200;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &ceres_problem, &summary);
  out.cost = 2 * summary.final_cost;
  out.iterations = static_cast<int>(summary.iterations.size());
  return out;
}

Solution solve_schur(const Problem& problem, const Weights& weights, double tolerance) {
  return solve_ceres(problem, weights, tolerance, ceres::DENSE_SCHUR);
}

Solution solve_normal(const Problem& problem, const Weights& weights, double tolerance) {
  return solve_ceres(problem, weights, tolerance, ceres::DENSE_NORMAL_CHOLESKY);
}

// All images at once, along (v, omega, c) about the start.
class Whole {
 public:
  using Scalar = double;
  enum { NUM_RESIDUALS = Eigen::Dynamic, NUM_PARAMETERS = 9 };
  Whole(const Problem& problem, const Weights& weights) : problem_(problem), weights_(weights) {}
  int NumResiduals() const { return 3 * static_cast<int>(problem_.images.size()); }

  bool operator()(const double* parameters, double* residuals, double* jacobian) const {
    Eigen::Map<const Vec3> shift(parameters), turn(parameters + 3), move(parameters + 6);
    const Mat3 step = quaternion_exp(turn).toRotationMatrix();
    const Mat3 first = problem_.rotation.toRotationMatrix();
    const Mat3 rotation = first * step;
    const Vec3 translation = problem_.translation + first * shift;
    const Vec3 point = problem_.point + move;
    // Along omega at omega: Exp(w + d) = Exp(w) Exp(J d), J the right Jacobian of SO(3).
    const Mat3 right = right_jacobian(turn);
    const Mat3 back = step.transpose();  // -dq/dv = Exp(w)'
    const int rows = NumResiduals();
    for (size_t i = 0; i < problem_.images.size(); ++i) {
      const Image& image = problem_.images[i];
      const Vec3 probe = image.rotation.transpose() * (point - image.translation) - translation;
      const Vec3 q = rotation.transpose() * probe;
      Mat3 slope;
      Eigen::Map<Vec3> r(residuals + 3 * i);
      r = residual_of(image, weights_, q, jacobian == nullptr ? nullptr : &slope);
      if (jacobian == nullptr) continue;
      Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, 9>> out(jacobian, rows, 9);
      out.block<3, 3>(3 * i, 0) = -slope * back;
      out.block<3, 3>(3 * i, 3) = slope * skew(q) * right;
      out.block<3, 3>(3 * i, 6) = slope * (rotation.transpose() * image.rotation.transpose());
    }
    return true;
  }

  void store(const Eigen::Matrix<double, 9, 1>& x, Solution* out) const {
    const Mat3 first = problem_.rotation.toRotationMatrix();
    const Eigen::Quaterniond turned = problem_.rotation * quaternion_exp(x.segment<3>(3));
    out->pose << turned.coeffs(), problem_.translation + first * x.head<3>();
    out->point = problem_.point + x.tail<3>();
  }

 private:
  static Mat3 right_jacobian(const Vec3& turn) {
    const double angle = turn.norm();
    const Mat3 cross = skew(turn);
    if (angle < 1e-6) return Mat3::Identity() - 0.5 * cross + cross * cross / 6.0;
    const double square = angle * angle;
    return Mat3::Identity() - (1 - std::cos(angle)) / square * cross +
           (angle - std::sin(angle)) / (square * angle) * cross * cross;
  }
  const Problem& problem_;
  const Weights& weights_;
};

Solution solve_tiny(const Problem& problem, const Weights& weights, double tolerance) {
  Solution out;
  Whole function(problem, weights);
  ceres::TinySolver<Whole> solver;
  solver.options.function_tolerance = tolerance;
  solver.options.gradient_tolerance = 1e-300;
  solver.options.parameter_tolerance = 1e-300;
  solver.options.cost_threshold = 0;
  solver.options.max_num_iterations = 200;
  Eigen::Matrix<double, 9, 1> x = Eigen::Matrix<double, 9, 1>::Zero();
  const auto& summary = solver.Solve(function, &x);
  std::vector<double> residuals(3 * problem.images.size());
  function(x.data(), residuals.data(), nullptr);
  function.store(x, &out);
  out.cost = 0;
  for (const double r : residuals) out.cost += r * r;
  out.iterations = summary.iterations;
  return out;
}

std::vector<double> read_doubles(const std::string& path) {
  std::ifstream stream(path, std::ios::binary | std::ios::ate);
  if (!stream) throw std::runtime_error("cannot read " + path);
  std::vector<double> values(static_cast<size_t>(stream.tellg()) / sizeof(double));
  stream.seekg(0);
  stream.read(reinterpret_cast<char*>(values.data()),
              static_cast<std::streamsize>(values.size() * sizeof(double)));
  return values;
}

// count, n, s (3); then per problem: start X (3x4 row-major), start c, and per image B
// (3x4 row-major), lateral, range.
std::vector<Problem> read_problems(const std::string& path, Weights* weights) {
  const std::vector<double> values = read_doubles(path);
  const auto count = static_cast<size_t>(values.at(0)), images = static_cast<size_t>(values.at(1));
  if (values.size() != 5 + count * (15 + 14 * images)) throw std::runtime_error("wrong size");
  *weights = Vec3(values[2], values[3], values[4]).cwiseInverse();
  const double* at = values.data() + 5;
  using Affine = Eigen::Matrix<double, 3, 4, Eigen::RowMajor>;
  std::vector<Problem> problems(count);
  for (Problem& problem : problems) {
    const Eigen::Map<const Affine> start(at);
    problem.rotation = Eigen::Quaterniond(Mat3(start.leftCols<3>()));
    problem.translation = start.col(3);
    problem.point = Eigen::Map<const Vec3>(at + 12);
    at += 15;
    problem.images.resize(images);
    for (Image& image : problem.images) {
      const Eigen::Map<const Affine> pose(at);
      image = {pose.leftCols<3>(), pose.col(3), at[12], at[13]};
      at += 14;
    }
  }
  return problems;
}

int main(int argc, char** argv) try {
  if (argc != 6) throw std::runtime_error("PROBLEMS RESULTS schur|normal|tiny TOLERANCE REPEATS");
  Weights weights;
  const std::vector<Problem> problems = read_problems(argv[1], &weights);
  const std::string solver = argv[3];
  if (solver != "schur" && solver != "normal" && solver != "tiny") throw std::runtime_error("no solver " + solver);
  const auto solve = solver == "schur"    ? solve_schur
                     : solver == "normal" ? solve_normal
                                          : solve_tiny;
  const double tolerance = std::atof(argv[4]);
  const int repeats = std::atoi(argv[5]);
  std::vector<Solution> solutions(problems.size());
  std::vector<double> seconds;
  for (int repeat = 0; repeat < repeats; ++repeat) {
    const auto begin = std::chrono::steady_clock::now();
    for (size_t k = 0; k < problems.size(); ++k)
      solutions[k] = solve(problems[k], weights, tolerance);
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
    seconds.push_back(took.count());
  }
  std::ofstream stream(argv[2], std::ios::binary);
  const auto put = [&stream](const double* values, size_t count) {
    stream.write(reinterpret_cast<const char*>(values),
                 static_cast<std::streamsize>(count * sizeof(double)));
  };
  for (const Solution& solution : solutions) {
    Eigen::Matrix<double, 3, 4, Eigen::RowMajor> matrix;
    matrix.leftCols<3>() =
        Eigen::Map<const Eigen::Quaterniond>(solution.pose.data()).toRotationMatrix();
    matrix.col(3) = solution.pose.tail<3>();
    put(matrix.data(), 12);
    put(solution.point.data(), 3);
    const double tail[2] = {solution.cost, static_cast<double>(solution.iterations)};
    put(tail, 2);
  }
  put(seconds.data(), seconds.size());
  return stream ? 0 : 1;
} catch (const std::exception& error) {
  std::fprintf(stderr, "ceres_peers: %s\n", error.what());
  return 2;
}
