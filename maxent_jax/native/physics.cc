// C MuJoCo on all cores, called from XLA without Python in between. See envs/mujoco_backend.py.

#include <mujoco/mujoco.h>

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <map>
#include <mutex>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using maxent::num_threads;
using maxent::parallel;
using Floats = ffi::Buffer<ffi::F32>;

// Functions of the MuJoCo that Python has loaded: this library is not linked against MuJoCo.
struct Functions {
  decltype(&mj_makeData) make_data;
  decltype(&mj_step) step;
  decltype(&mj_forward) forward;
  decltype(&mj_rnePostConstraint) rne_post_constraint;
};

// A field of mjData that is observed in addition to the state.
struct Field {
  mjtNum* mjData::* values;
  int64_t size;
};

struct NamedField {
  std::string_view name;
  mjtNum* mjData::* values;
};

constexpr NamedField kFields[] = {
    {"cinert", &mjData::cinert},
    {"cvel", &mjData::cvel},
    {"qfrc_actuator", &mjData::qfrc_actuator},
    {"cfrc_ext", &mjData::cfrc_ext},
};

// A model and scratch space for the threads that step it.
class Simulator {
 public:
  Simulator(Functions functions, const mjModel* model, std::vector<Field> derived)
      : functions_(functions), model_(model), derived_(std::move(derived)) {}

  struct Rows {
    const float *qpos, *qvel, *warmstart, *control;
    float *next_qpos, *next_qvel, *next_warmstart, *derived;
  };

  // Steps rows [from, to). With 0 substeps it only evaluates the state.
  void run(const Rows& rows, int64_t from, int64_t to, int64_t num_substeps) {
    mjData* data = take();
    const int64_t nq = model_->nq, nv = model_->nv, nu = model_->nu;
    int64_t derived_size = 0;
    for (const Field& field : derived_) derived_size += field.size;
    for (int64_t i = from; i < to; ++i) {
      data->time = 0;
      std::copy_n(rows.qpos + i * nq, nq, data->qpos);
      std::copy_n(rows.qvel + i * nv, nv, data->qvel);
      std::copy_n(rows.warmstart + i * nv, nv, data->qacc_warmstart);
      std::copy_n(rows.control + i * nu, nu, data->ctrl);
      for (int64_t step = 0; step < num_substeps; ++step) functions_.step(model_, data);
      if (num_substeps == 0) {
        std::fill_n(data->cfrc_ext, 6 * model_->nbody, 0);
        functions_.forward(model_, data);
      } else if (!derived_.empty()) {  // as Gymnasium does after its steps
        functions_.rne_post_constraint(model_, data);
      }
      std::copy_n(data->qpos, nq, rows.next_qpos + i * nq);
      std::copy_n(data->qvel, nv, rows.next_qvel + i * nv);
      std::copy_n(data->qacc_warmstart, nv, rows.next_warmstart + i * nv);
      float* out = rows.derived + i * derived_size;
      for (const Field& field : derived_) out = std::copy_n(data->*field.values, field.size, out);
    }
    give_back(data);
  }

 private:
  mjData* take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return functions_.make_data(model_);
    mjData* data = idle_.back();
    idle_.pop_back();
    return data;
  }

  void give_back(mjData* data) {
    const std::lock_guard<std::mutex> lock(mutex_);
    idle_.push_back(data);
  }

  const Functions functions_;
  const mjModel* const model_;
  const std::vector<Field> derived_;
  std::mutex mutex_;
  std::vector<mjData*> idle_;
};

struct Simulators {
  std::mutex mutex;
  std::map<std::string, Simulator, std::less<>> by_name;
};

// Made at first use, so that loading this library runs none of its code; never destroyed, since
// MuJoCo may be unloaded by then.
Simulators& simulators() {
  static auto& made = *new Simulators;
  return made;
}

ffi::Error step(ffi::ThreadPool pool, Floats qpos, Floats qvel, Floats warmstart, Floats control,
                std::string_view model, int64_t num_substeps, ffi::Result<Floats> next_qpos,
                ffi::Result<Floats> next_qvel, ffi::Result<Floats> next_warmstart,
                ffi::Result<Floats> derived) {
  Simulator* simulator = nullptr;
  {
    const std::lock_guard<std::mutex> lock(simulators().mutex);
    const auto found = simulators().by_name.find(model);
    if (found == simulators().by_name.end())
      return ffi::Error(ffi::ErrorCode::kNotFound, "the model of a program is not loaded");
    simulator = &found->second;
  }
  const Simulator::Rows rows{
      qpos.typed_data(),       qvel.typed_data(),       warmstart.typed_data(),
      control.typed_data(),    next_qpos->typed_data(), next_qvel->typed_data(),
      next_warmstart->typed_data(), derived->typed_data(),
  };
  const auto shape = qpos.dimensions();
  const int64_t count = qpos.element_count() / shape[shape.size() - 1];
  // Several jobs for each thread, since robots that lie on the ground take longer.
  const int64_t share = std::max<int64_t>(1, count / (8 * num_threads(pool)));
  parallel(pool, (count + share - 1) / share, [&](int64_t job) {
    simulator->run(rows, job * share, std::min(count, (job + 1) * share), num_substeps);
  });
  return ffi::Error::Success();
}

}  // namespace

// The version of MuJoCo whose structures this file was compiled for.
extern "C" int maxent_mujoco_version() { return mjVERSION_HEADER; }

// Adds a model under a name, by which programs refer to it, also those that another process
// compiled. The model must outlive all use; `functions` are in the order of Functions. Returns
// whether all derived fields are known.
extern "C" bool maxent_add_model(const char* name, const mjModel* model, const Functions* functions,
                                 const char* const* derived, const int64_t* sizes, int64_t count) {
  std::vector<Field> fields;
  for (int64_t i = 0; i < count; ++i) {
    const auto found = std::find_if(std::begin(kFields), std::end(kFields),
                                    [&](const NamedField& field) { return field.name == derived[i]; });
    if (found == std::end(kFields)) return false;
    fields.push_back({found->values, sizes[i]});
  }
  const std::lock_guard<std::mutex> lock(simulators().mutex);
  simulators().by_name.try_emplace(name, *functions, model, std::move(fields));
  return true;
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(maxent_physics, step,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Attr<std::string_view>("model")
                                  .Attr<int64_t>("num_substeps")
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>());
