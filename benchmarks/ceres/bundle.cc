// The two networks of the benchmark adjusted by Ceres: time to the cost asked for, and to its own convergence.
//
//   bundle bal NETWORK COST      BAL file; each image has f, k1, k2 of its own
//   bundle shared NETWORK COST   one camera c, x0, y0, K1, K2 (image side) for all, as benchmarks/bundle.py writes it
//   bundle fisheye NETWORK COST  one camera fx, fy, cx, cy, k1 ... k4 of OpenCV's fisheye for all
//   bundle rig NETWORK COST      cameras c, K1 (object side) fixed to each other; one pose for each exposure
//
// With a fourth argument `iterative` the normal equations are solved by conjugate gradients.
//
// Prints: processor seconds until half the sum of squares is at most COST, processor seconds in all, final cost, iterations.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <string>
#include <vector>

namespace {

struct BalResidual {
  BalResidual(double x, double y) : x(x), y(y) {}
  template <typename T>
  bool operator()(const T* camera, const T* point, T* residual) const {
    T p[3];
    ceres::AngleAxisRotatePoint(camera, point, p);
    for (int i = 0; i < 3; ++i) p[i] += camera[3 + i];
    const T u = -p[0] / p[2], v = -p[1] / p[2], s = u * u + v * v;
    const T scale = camera[6] * (1.0 + s * (camera[7] + s * camera[8]));
    residual[0] = scale * u - x;
    residual[1] = scale * v - y;
    return true;
  }
  double x, y;
};

struct SharedResidual {
  SharedResidual(double x, double y, double pitch) : x(x), y(y), pitch(pitch) {}
  template <typename T>
  bool operator()(const T* interior, const T* pose, const T* point, T* residual) const {
    T d[3], p[3];
    for (int i = 0; i < 3; ++i) d[i] = point[i] - pose[3 + i];
    ceres::AngleAxisRotatePoint(pose, d, p);
    const T xm = T(x) - interior[1], ym = T(y) - interior[2], s = xm * xm + ym * ym;
    const T bent = 1.0 + s * (interior[3] + s * interior[4]);
    residual[0] = (interior[0] * p[0] / p[2] - xm * bent) / pitch;
    residual[1] = (-interior[0] * p[1] / p[2] - ym * bent) / pitch;
    return true;
  }
  double x, y, pitch;
};

struct FisheyeResidual {
  FisheyeResidual(double x, double y, double sigma) : x(x), y(y), sigma(sigma) {}
  template <typename T>
  bool operator()(const T* interior, const T* pose, const T* point, T* residual) const {
    T d[3], p[3];
    for (int i = 0; i < 3; ++i) d[i] = point[i] - pose[3 + i];
    ceres::AngleAxisRotatePoint(pose, d, p);
    const T r = ceres::sqrt(p[0] * p[0] + p[1] * p[1]);
    const T angle = ceres::atan2(r, p[2]), s = angle * angle;
    const T* k = interior + 4;
    const T scale = angle * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))) / r;
    residual[0] = (interior[0] * scale * p[0] + interior[2] - x) / sigma;
    residual[1] = (interior[1] * scale * p[1] + interior[3] - y) / sigma;
    return true;
  }
  double x, y, sigma;
};

struct RigResidual {
  RigResidual(double x, double y, double sigma) : x(x), y(y), sigma(sigma) {}
  template <typename T>
  bool operator()(const T* interior, const T* place, const T* pose, const T* point, T* residual) const {
    T d[3], p[3], q[3];
    for (int i = 0; i < 3; ++i) d[i] = point[i] - pose[3 + i];
    ceres::AngleAxisRotatePoint(pose, d, p);
    for (int i = 0; i < 3; ++i) p[i] -= place[3 + i];
    ceres::AngleAxisRotatePoint(place, p, q);
    const T xs = interior[0] * q[0] / q[2], ys = -interior[0] * q[1] / q[2];
    const T scale = 1.0 + interior[1] * (xs * xs + ys * ys);
    residual[0] = (xs * scale - x) / sigma;
    residual[1] = (ys * scale - y) / sigma;
    return true;
  }
  double x, y, sigma;
};

class Watch : public ceres::IterationCallback {
 public:
  explicit Watch(double target) : target(target), begun(std::clock()) {}
  ceres::CallbackReturnType operator()(const ceres::IterationSummary& summary) override {
    if (reached < 0 && summary.cost <= target) reached = seconds();
    return ceres::SOLVER_CONTINUE;
  }
  double seconds() const {
    return static_cast<double>(std::clock() - begun) / CLOCKS_PER_SEC;
  }
  double target, reached = -1;

 private:
  std::clock_t begun;
};

// Adjusts and prints; `begun` is not included.
void solve(ceres::Problem& problem, std::shared_ptr<ceres::ParameterBlockOrdering> ordering, double target,
           double built, bool iterative = false) {
  ceres::Solver::Options options;
  options.linear_solver_type = iterative ? ceres::ITERATIVE_SCHUR : ceres::DENSE_SCHUR;
  options.preconditioner_type = iterative ? ceres::SCHUR_JACOBI : ceres::JACOBI;
  options.linear_solver_ordering = ordering;
  options.num_threads = 2;
  options.max_num_iterations = 200;
  options.function_tolerance = 1e-6;
  Watch watch(target);
  options.callbacks.push_back(&watch);
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  std::printf("%.6f %.6f %.10g %zu %.6f\n", watch.reached, watch.seconds(), summary.final_cost,
              summary.iterations.size() - 1, built);
}

int rig(std::ifstream& file, double target) {
  int cameras, exposures, points, observations;
  double sigma;
  file >> cameras >> exposures >> points >> observations >> sigma;
  std::vector<double> interior(2 * cameras), place(6 * cameras), pose(6 * exposures), xyz(3 * points);
  for (auto* column : {&interior, &place, &pose, &xyz})
    for (double& value : *column) file >> value;
  ceres::Problem problem;
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (int k = 0; k < observations; ++k) {
    int c, e, j;
    double x, y;
    file >> c >> e >> j >> x >> y;
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<RigResidual, 2, 2, 6, 6, 3>(new RigResidual(x, y, sigma)), nullptr,
        &interior[2 * c], &place[6 * c], &pose[6 * e], &xyz[3 * j]);
  }
  if (!file) return 3;
  problem.SetParameterBlockConstant(place.data());
  for (int j = 0; j < points; ++j) ordering->AddElementToGroup(&xyz[3 * j], 0);
  for (int e = 0; e < exposures; ++e) ordering->AddElementToGroup(&pose[6 * e], 1);
  for (int c = 0; c < cameras; ++c) {
    ordering->AddElementToGroup(&interior[2 * c], 1);
    ordering->AddElementToGroup(&place[6 * c], 1);
  }
  solve(problem, ordering, target, 0.0);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4 && argc != 5) return 2;
  const bool iterative = argc == 5 && std::string(argv[4]) == "iterative";
  const std::string kind = argv[1];
  std::ifstream file(argv[2]);
  if (kind == "rig") return rig(file, std::atof(argv[3]));
  int images, points, observations;
  double pitch = 1;
  file >> images >> points >> observations;
  const bool one = kind != "bal";
  std::vector<double> interior(kind == "fisheye" ? 8 : 5);
  if (one) {
    file >> pitch;
    for (double& value : interior) file >> value;
  }
  std::vector<int> image(observations), point(observations);
  std::vector<double> x(observations), y(observations);
  for (int k = 0; k < observations; ++k) file >> image[k] >> point[k] >> x[k] >> y[k];
  const int width = one ? 6 : 9;
  std::vector<double> cameras(width * images), xyz(3 * points);
  for (double& value : cameras) file >> value;
  for (double& value : xyz) file >> value;
  if (!file) return 3;

  const auto begun = std::chrono::steady_clock::now();
  ceres::Problem problem;
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (int k = 0; k < observations; ++k) {
    double* camera = &cameras[width * image[k]];
    double* where = &xyz[3 * point[k]];
    if (kind == "shared") {
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<SharedResidual, 2, 5, 6, 3>(new SharedResidual(x[k], y[k], pitch)),
          nullptr, interior.data(), camera, where);
    } else if (kind == "fisheye") {
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<FisheyeResidual, 2, 8, 6, 3>(new FisheyeResidual(x[k], y[k], pitch)),
          nullptr, interior.data(), camera, where);
    } else {
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<BalResidual, 2, 9, 3>(new BalResidual(x[k], y[k])), nullptr, camera,
          where);
    }
  }
  for (int j = 0; j < points; ++j)
    if (problem.HasParameterBlock(&xyz[3 * j])) ordering->AddElementToGroup(&xyz[3 * j], 0);
  for (int i = 0; i < images; ++i)
    if (problem.HasParameterBlock(&cameras[width * i])) ordering->AddElementToGroup(&cameras[width * i], 1);
  if (one) ordering->AddElementToGroup(interior.data(), 1);
  const double built = std::chrono::duration<double>(std::chrono::steady_clock::now() - begun).count();

  solve(problem, ordering, std::atof(argv[3]), built, iterative);
  return 0;
}
