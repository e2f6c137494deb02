// The explicit joint problem of jaxcal, solved one by one on one thread by Ceres (DENSE_SCHUR) and
// by its TinySolver with every offset eliminated by hand.
//
// Per image i, with q_i = X^-1 B_i^-1 c and p_i(y) = (x_i, y, sqrt(r_i^2 - y^2)):
//     minimise over X, c, y   sum_i |w .* (q_i - p_i(y_i))|^2 + (y_i / s)^2.
// X steps by the right perturbation about its current value, X Exp([v, omega]) with Exp's
// translation taken as v, as in jaxcal.
//
// usage: ceres_peers PROBLEMS RESULTS SOLVER TOLERANCE REPEATS
// PROBLEMS: binary float64, see read_problems. SOLVER: schur | tiny.
// RESULTS: per problem X (12, row-major 3x4), c (3), y (n), cost, iterations; then REPEATS seconds.

#include <ceres/ceres.h>
#include <ceres/tiny_solver.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
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

constexpr double kLargest = 0.95;  // offsets stay below this fraction of the range

struct Image {
  Mat3 rotation;  // B_i
  Vec3 translation;
  double lateral, range;
};

struct Weights {
  Vec3 point;        // 1 / SD of the three components of q - p
  double elevation;  // 1 / SD of the offset
};

// X as quaternion (x y z w, Eigen's order) and translation.
struct Problem {
  std::vector<Image> images;
  Eigen::Quaterniond rotation;
  Vec3 translation, point;
};

struct Solution {
  Eigen::Matrix<double, 7, 1> pose;
  Vec3 point;
  std::vector<double> offsets;
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

inline double axial_of(double range, double offset) {
  return std::sqrt(std::max(range * range - offset * offset, 1e-12 * range * range));
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

// Residuals (4) of one image and their derivatives along v, omega, c and its offset.
class ImageCost final : public ceres::SizedCostFunction<4, 7, 3, 1> {
 public:
  ImageCost(const Image& image, const Weights& weights) : image_(image), weights_(weights) {}
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    Eigen::Map<const Eigen::Quaterniond> rotation(parameters[0]);
    Eigen::Map<const Vec3> translation(parameters[0] + 4), point(parameters[1]);
    const double offset = parameters[2][0];
    const Mat3 turn = rotation.toRotationMatrix();
    const Vec3 probe = image_.rotation.transpose() * (point - image_.translation) - translation;
    const Vec3 q = turn.transpose() * probe;
    const double axial = axial_of(image_.range, offset);
    Eigen::Map<Eigen::Vector4d> r(residuals);
    r.head<3>() = weights_.point.cwiseProduct(q - Vec3(image_.lateral, offset, axial));
    r[3] = weights_.elevation * offset;
    if (jacobians == nullptr) return true;
    const auto scale = weights_.point.asDiagonal();
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 4, 7, Eigen::RowMajor>> j(jacobians[0]);
      j.setZero();
      j.topLeftCorner<3, 3>() = -1.0 * Mat3(scale);
      j.block<3, 3>(0, 3) = scale * skew(q);
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 4, 3, Eigen::RowMajor>> j(jacobians[1]);
      j.topRows<3>() = scale * (turn.transpose() * image_.rotation.transpose());
      j.row(3).setZero();
    }
    if (jacobians[2] != nullptr) {
      Eigen::Map<Eigen::Vector4d> j(jacobians[2]);
      j << 0, -weights_.point.y(), weights_.point.z() * offset / axial, weights_.elevation;
    }
    return true;
  }

 private:
  const Image& image_;
  const Weights& weights_;
};

Solution solve_schur(const Problem& problem, const Weights& weights, double tolerance) {
  Solution out;
  out.pose << problem.rotation.coeffs(), problem.translation;
  out.point = problem.point;
  out.offsets.assign(problem.images.size(), 0.0);
  ceres::Problem ceres_problem;
  ceres_problem.AddParameterBlock(out.pose.data(), 7, new PoseManifold);
  ceres_problem.AddParameterBlock(out.point.data(), 3);
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (size_t i = 0; i < problem.images.size(); ++i) {
    double* offset = &out.offsets[i];
    ceres_problem.AddResidualBlock(new ImageCost(problem.images[i], weights), nullptr,
                                   out.pose.data(), out.point.data(), offset);
    ordering->AddElementToGroup(offset, 0);
  }
  ordering->AddElementToGroup(out.pose.data(), 1);
  ordering->AddElementToGroup(out.point.data(), 1);
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.linear_solver_ordering.reset(new ceres::ParameterBlockOrdering(*ordering));
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

// y eliminated by hand: at every (X, c) each offset is taken to its own optimum by Newton steps on
// its scalar problem, and the Jacobian loses its component along the offset (Kaufman).
class Eliminated {
 public:
  using Scalar = double;
  enum { NUM_RESIDUALS = Eigen::Dynamic, NUM_PARAMETERS = 9 };
  Eliminated(const Problem& problem, const Weights& weights)
      : problem_(problem), weights_(weights), offsets_(problem.images.size(), 0.0) {}
  int NumResiduals() const { return 4 * static_cast<int>(problem_.images.size()); }

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
    const Vec3 w = weights_.point;
    const int rows = NumResiduals();
    for (size_t i = 0; i < problem_.images.size(); ++i) {
      const Image& image = problem_.images[i];
      const Vec3 probe = image.rotation.transpose() * (point - image.translation) - translation;
      const Vec3 q = rotation.transpose() * probe;
      double y = offsets_[i];
      const double largest = kLargest * image.range;
      double z = axial_of(image.range, y);
      for (int k = 0; k < 20; ++k) {
        const double slope_z = -y / z;
        const double ey = w.y() * w.y() * (q.y() - y), ez = w.z() * w.z() * (q.z() - z);
        const double gradient = -ey - ez * slope_z + weights_.elevation * weights_.elevation * y;
        double curvature = w.y() * w.y() + w.z() * w.z() * slope_z * slope_z +
                           weights_.elevation * weights_.elevation;
        const double full = curvature + ez * (image.range * image.range) / (z * z * z);
        if (full > 0) curvature = full;
        const double next = std::clamp(y - gradient / curvature, -largest, largest);
        const double moved = std::abs(next - y);
        y = next;
        z = axial_of(image.range, y);
        if (moved <= 1e-13 * image.range) break;
      }
      offsets_[i] = y;
      const Vec3 e = q - Vec3(image.lateral, y, z);
      Eigen::Map<Eigen::Vector4d> r(residuals + 4 * i);
      r << w.cwiseProduct(e), weights_.elevation * y;
      if (jacobian == nullptr) continue;
      Eigen::Matrix<double, 4, 9> j;
      j.row(3).setZero();
      j.topLeftCorner<3, 3>() = -(w.asDiagonal() * back);
      j.block<3, 3>(0, 3) = w.asDiagonal() * (skew(q) * right);
      j.block<3, 3>(0, 6) = w.asDiagonal() * (rotation.transpose() * image.rotation.transpose());
      Eigen::Vector4d k(0, -w.y(), w.z() * y / z, weights_.elevation);
      const Eigen::Matrix<double, 1, 9> along = k.transpose() * j / k.squaredNorm();
      j -= k * along;
      Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, 9>> out(jacobian, rows, 9);
      out.middleRows<4>(4 * i) = j;
    }
    return true;
  }

  void store(const Eigen::Matrix<double, 9, 1>& x, Solution* out) const {
    const Mat3 first = problem_.rotation.toRotationMatrix();
    const Eigen::Quaterniond turned = problem_.rotation * quaternion_exp(x.segment<3>(3));
    out->pose << turned.coeffs(), problem_.translation + first * x.head<3>();
    out->point = problem_.point + x.tail<3>();
    out->offsets = offsets_;
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
  mutable std::vector<double> offsets_;
};

Solution solve_tiny(const Problem& problem, const Weights& weights, double tolerance) {
  Solution out;
  Eliminated function(problem, weights);
  ceres::TinySolver<Eliminated> solver;
  solver.options.function_tolerance = tolerance;
  solver.options.gradient_tolerance = 1e-300;
  solver.options.parameter_tolerance = 1e-300;
  solver.options.cost_threshold = 0;
  solver.options.max_num_iterations = 200;
  Eigen::Matrix<double, 9, 1> x = Eigen::Matrix<double, 9, 1>::Zero();
  const auto& summary = solver.Solve(function, &x);
  std::vector<double> residuals(4 * problem.images.size());
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

// count, n, w (3), 1 / s; then per problem: start X (3x4 row-major), start c, and per image B
// (3x4 row-major), lateral, range.
std::vector<Problem> read_problems(const std::string& path, Weights* weights) {
  const std::vector<double> values = read_doubles(path);
  const auto count = static_cast<size_t>(values.at(0)), images = static_cast<size_t>(values.at(1));
  if (values.size() != 6 + count * (15 + 14 * images)) throw std::runtime_error("wrong size");
  weights->point = Vec3(values[2], values[3], values[4]);
  weights->elevation = values[5];
  const double* at = values.data() + 6;
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
  if (argc != 6) throw std::runtime_error("PROBLEMS RESULTS schur|tiny TOLERANCE REPEATS");
  Weights weights;
  const std::vector<Problem> problems = read_problems(argv[1], &weights);
  const std::string solver = argv[3];
  if (solver != "schur" && solver != "tiny") throw std::runtime_error("no solver " + solver);
  const auto solve = solver == "schur" ? solve_schur : solve_tiny;
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
    put(solution.offsets.data(), solution.offsets.size());
    const double tail[2] = {solution.cost, static_cast<double>(solution.iterations)};
    put(tail, 2);
  }
  put(seconds.data(), seconds.size());
  return stream ? 0 : 1;
} catch (const std::exception& error) {
  std::fprintf(stderr, "ceres_peers: %s\n", error.what());
  return 2;
}
