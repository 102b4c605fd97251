// C MuJoCo on all cores, called from XLA without Python in between. See envs/mujoco_backend.py.

#include <mujoco/mujoco.h>

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using maxent::Jobs;
using maxent::num_threads;
using maxent::offer;
using Floats = ffi::Buffer<ffi::F32>;
using Words = ffi::Buffer<ffi::U32>;
using Tickets = ffi::Buffer<ffi::S32>;

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

Simulator* find(std::string_view model) {
  const std::lock_guard<std::mutex> lock(simulators().mutex);
  const auto found = simulators().by_name.find(model);
  return found == simulators().by_name.end() ? nullptr : &found->second;
}

ffi::Error not_loaded() {
  return ffi::Error(ffi::ErrorCode::kNotFound, "the model of a program is not loaded");
}

int64_t num_rows(const Floats& x) {
  const auto shape = x.dimensions();
  return x.element_count() / shape[shape.size() - 1];
}

struct Divided {
  std::shared_ptr<Jobs> jobs;
  int64_t count;
};

// Divides a step of `count` rows into several jobs for each thread, since robots that lie on the
// ground take longer.
Divided divide(ffi::ThreadPool& pool, Simulator* simulator, const Simulator::Rows& rows,
               int64_t count, int64_t num_substeps) {
  const int64_t share = std::max<int64_t>(1, count / (8 * num_threads(pool)));
  const int64_t num_jobs = (count + share - 1) / share;
  auto jobs = std::make_shared<Jobs>(num_jobs, [=](int64_t job) {
    simulator->run(rows, job * share, std::min(count, (job + 1) * share), num_substeps);
  });
  return {std::move(jobs), num_jobs};
}

ffi::Error step(ffi::ThreadPool pool, Floats qpos, Floats qvel, Floats warmstart, Floats control,
                std::string_view model, int64_t num_substeps, ffi::Result<Floats> next_qpos,
                ffi::Result<Floats> next_qvel, ffi::Result<Floats> next_warmstart,
                ffi::Result<Floats> derived) {
  Simulator* simulator = find(model);
  if (simulator == nullptr) return not_loaded();
  const Simulator::Rows rows{
      qpos.typed_data(),       qvel.typed_data(),       warmstart.typed_data(),
      control.typed_data(),    next_qpos->typed_data(), next_qvel->typed_data(),
      next_warmstart->typed_data(), derived->typed_data(),
  };
  const Divided step = divide(pool, simulator, rows, num_rows(qpos), num_substeps);
  offer(pool, step.jobs, step.count - 1);
  step.jobs->finish();
  return ffi::Error::Success();
}

// A step that XLA's idle threads take while the program goes on. Between `start` and `finish` its
// data lies here, since XLA would use the memory for something else.
struct Started {
  std::vector<float> inputs, outputs;
  std::shared_ptr<Jobs> jobs;
};

struct StartedSteps {
  std::mutex mutex;
  int32_t last = 0;
  std::map<int32_t, std::shared_ptr<Started>> by_ticket;
};

StartedSteps& started_steps() {
  static auto& made = *new StartedSteps;
  return made;
}

// Starts a step and returns a ticket for it. `key` is returned unchanged: what is computed from the
// result runs after the start, whatever order XLA would prefer.
ffi::Error start(ffi::ThreadPool pool, Floats qpos, Floats qvel, Floats warmstart, Floats control,
                 Words key, std::string_view model, int64_t num_substeps, int64_t derived_size,
                 ffi::Result<Tickets> ticket, ffi::Result<Words> same_key) {
  Simulator* simulator = find(model);
  if (simulator == nullptr) return not_loaded();
  const int64_t count = num_rows(qpos);
  auto started = std::make_shared<Started>();
  const Floats* const inputs[] = {&qpos, &qvel, &warmstart, &control};
  size_t offsets[4];
  for (int i = 0; i < 4; ++i) {
    const float* values = inputs[i]->typed_data();
    offsets[i] = started->inputs.size();
    started->inputs.insert(started->inputs.end(), values, values + inputs[i]->element_count());
  }
  const size_t position = qpos.element_count(), velocity = qvel.element_count();
  started->outputs.resize(position + 2 * velocity + count * derived_size);
  const float* in = started->inputs.data();
  float* out = started->outputs.data();
  const Simulator::Rows rows{
      in + offsets[0],    in + offsets[1],           in + offsets[2],
      in + offsets[3],    out,                       out + position,
      out + position + velocity, out + position + 2 * velocity,
  };
  const Divided step = divide(pool, simulator, rows, count, num_substeps);
  started->jobs = step.jobs;
  int32_t number;
  {
    const std::lock_guard<std::mutex> lock(started_steps().mutex);
    number = ++started_steps().last;
    started_steps().by_ticket.emplace(number, started);
  }
  std::fill_n(ticket->typed_data(), ticket->element_count(), number);
  std::copy_n(key.typed_data(), key.element_count(), same_key->typed_data());
  offer(pool, step.jobs, step.count);
  return ffi::Error::Success();
}

// Returns the results of the step that `start` began. `after` is not read: it is computed by what
// must precede this call.
ffi::Error finish(Tickets ticket, Floats after, ffi::Result<Floats> next_qpos,
                  ffi::Result<Floats> next_qvel, ffi::Result<Floats> next_warmstart,
                  ffi::Result<Floats> derived) {
  std::shared_ptr<Started> started;
  {
    const std::lock_guard<std::mutex> lock(started_steps().mutex);
    const auto found = started_steps().by_ticket.find(ticket.typed_data()[0]);
    if (found == started_steps().by_ticket.end())
      return ffi::Error(ffi::ErrorCode::kNotFound, "a step to finish was not started");
    started = found->second;
    started_steps().by_ticket.erase(found);
  }
  started->jobs->finish();
  const float* from = started->outputs.data();
  for (auto* to : {&next_qpos, &next_qvel, &next_warmstart, &derived}) {
    std::copy_n(from, (*to)->element_count(), (*to)->typed_data());
    from += (*to)->element_count();
  }
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

XLA_FFI_DEFINE_HANDLER_SYMBOL(maxent_physics_start, start,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Words>()
                                  .Attr<std::string_view>("model")
                                  .Attr<int64_t>("num_substeps")
                                  .Attr<int64_t>("derived_size")
                                  .Ret<Tickets>()
                                  .Ret<Words>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(maxent_physics_finish, finish,
                              ffi::Ffi::Bind()
                                  .Arg<Tickets>()
                                  .Arg<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>());
