// Threads that fail, and the order and checks of plans.

#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <new>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "check.h"
#include "cpu/blocks.h"
#include "cpu/cache.h"
#include "cpu/plan.h"
#include "cpu/team.h"

using namespace gmem;

template <class Error, class Work>
std::string thrown(const Work& work) {
  try {
    work();
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}

void a_failed_rank_is_thrown_when_all_have_ended() {
  for (int failing = 0; failing < 4; ++failing) {
    std::atomic<int> ended{0};
    const std::string what = thrown<std::runtime_error>([&] {
      run_ranks(4, [&](int rank) {
        if (rank == failing) throw std::runtime_error("rank " + std::to_string(rank));
        ++ended;
      });
    });
    CHECK(what == "rank " + std::to_string(failing));
    CHECK(ended == 3);
  }
}

void a_container_s_quota_is_found() {
  char folder[] = "/tmp/gmem-quota-XXXXXX";
  CHECK(mkdtemp(folder) != nullptr);
  const std::string root = folder, groups = root + "/groups";
  const auto write = [](const std::string& path, const char* text) {
    std::filesystem::create_directories(std::filesystem::path(path).parent_path());
    std::ofstream(path) << text;
  };
  const int none = std::numeric_limits<int>::max();
  CHECK(quota_of(groups, root) == none);  // no such file
  write(groups, "0::/pod/box\n");
  write(root + "/pod/box/cpu.max", "max 100000\n");
  CHECK(quota_of(groups, root) == none);
  write(root + "/pod/cpu.max", "250000 100000\n");  // a group above
  CHECK(quota_of(groups, root) == 3);
  write(root + "/pod/box/cpu.max", "50000 100000\n");
  CHECK(quota_of(groups, root) == 1);
  write(groups, "5:devices:/pod\n4:cpu,cpuacct:/elsewhere/box\n0::/\n");  // version 1; its path is the host's
  write(root + "/cpu/cpu.cfs_period_us", "100000\n");
  write(root + "/cpu/cpu.cfs_quota_us", "-1\n");
  CHECK(quota_of(groups, root) == none);
  write(root + "/cpu/cpu.cfs_quota_us", "200000\n");
  CHECK(quota_of(groups, root) == 2);
  std::filesystem::remove_all(root);
}

void a_team_does_not_wait_for_one_that_failed() {
  Team team(3);
  std::atomic<int> through{0};
  const std::string what = thrown<std::runtime_error>([&] {
    run_ranks(3, [&](int rank) {
      team.run([&] {
        team.barrier();
        if (rank == 1) throw std::runtime_error("lost");
        team.barrier();
        ++through;
      });
    });
  });
  CHECK(what == "lost");
  CHECK(through == 0);
}

// New teams, since the first time that a share is opened is not like the others; and phases of more and fewer chunks than
// the one before, since a rank that is done with its own looks into shares that were not yet opened.
void every_chunk_of_a_phase_is_done_once() {
  constexpr int kPhases = 4, kChunks[kPhases] = {1, 3, 0, 5};
  int wrong = 0;
  for (int repeat = 0; repeat < 50000; ++repeat) {
    Team team(2);
    std::atomic<int> times[kPhases][5] = {};
    run_ranks(team.size(), [&](int rank) {
      for (int phase = 0; phase < kPhases; ++phase) {
        team.barrier();
        team.share(Team::kGrains, rank, kChunks[phase]);
        for (int chunk; team.take(Team::kGrains, rank, &chunk);) ++times[phase][chunk];
      }
    });
    for (int phase = 0; phase < kPhases; ++phase)
      for (int chunk = 0; chunk < 5; ++chunk) wrong += times[phase][chunk] != (chunk < kChunks[phase]);
  }
  CHECK(wrong == 0);
}

// Four grains of one sphere in a row, far ones first in the list.
struct Row {
  std::vector<int32_t> first{2, 0, 0, 1}, second{3, 0, 1, 2};
  bool valid[4] = {true, false, true, true};
  std::vector<double> reference{0.1, 0.5, 0.5, 0.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.7, 0.5, 0.5}, smallest{10.0, 3.0, 3.0};
  List list() const { return {4, 1, 4, first.data(), second.data(), valid, reference.data(), smallest.data()}; }
};

void plans_keep_neighbours_together_and_padding_apart() {
  const Row row;
  const auto store = plan_for(row.list());
  const Plan& plan = store->plan;
  CHECK(plan.candidates == 3 && plan.padding == 1 && plan.padding_row[0] == 1 && plan.domains == 1);
  for (int g = 0; g < 4; ++g) CHECK(plan.grain[g] == g);
  for (int c = 0; c < 3; ++c) {
    CHECK(plan.candidate[c].one == c && plan.candidate[c].other == c + 1 && plan.candidate[c].remote == -1);
    CHECK(plan.candidate[c].row == (c + 2) % 4);
  }
  CHECK(plan_for(row.list()) == store);  // remembered
}

void lists_that_lead_astray_are_refused() {
  const auto refused = [](int32_t one, int32_t other) {
    Row row;
    row.first[3] = one, row.second[3] = other;
    return thrown<std::invalid_argument>([&] { plan_for(row.list()); }).find("candidate 3 joins") == 0;
  };
  CHECK(refused(-1, 2) && refused(1, 4) && refused(2, 1) && refused(1, 1));
  CHECK(!refused(1, 3));
}

// A kernel whose third block, or every team's last thread, runs out of memory.
std::size_t no_scratch(const Problem&, const Block&) { return 64; }
void fail(const Problem&, const Block& block, Team& team, int rank, void*) {
  team.barrier();
  if (block.count == 3 && rank == team.size() - 1) throw std::bad_alloc();
  team.barrier();
}

void a_failed_block_fails_the_call_and_not_the_next() {
  const InstructionSet kernel{"test", 1, no_scratch, fail};
  Plan plan{};
  plan.domains = 64;
  const Pack pack{&plan, nullptr};
  for (const int threads : {1, 2, 4})
    for (int repeat = 0; repeat < 20; ++repeat) {
      std::vector<Block> blocks;
      for (int n = 1; n <= 5; ++n) blocks.push_back({&pack, nullptr, nullptr, nullptr, nullptr, n, false});
      const Threads held(threads);
      CHECK(held.count == threads);
      CHECK(!thrown<std::bad_alloc>([&] { run_blocks(Problem{}, kernel, blocks, held.count); }).empty());
      blocks.erase(blocks.begin() + 2);
      run_blocks(Problem{}, kernel, blocks, held.count);
      run_blocks(Problem{}, kernel, {blocks[0]}, held.count);
    }
}

void calls_at_once_share_out_the_cpus() {
  for (int repeat = 0; repeat < 20; ++repeat) {
    std::atomic<int> used{0}, most{0};
    std::vector<std::thread> callers;
    for (int n = 0; n < 8; ++n)
      callers.emplace_back([&] {
        const Threads held(2);
        const int now = used += held.count;
        if (now > most) most = now;
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
        used -= held.count;
      });
    for (std::thread& caller : callers) caller.join();
    CHECK(used == 0 && most <= std::max(2u, std::thread::hardware_concurrency()));
  }
}

// Whether a child that repeats what its parent did with threads ends well, and soon.
template <class Work>
bool survives_a_fork(const Work& work) {
  work();
  const pid_t child = fork();
  if (child == 0) {
    alarm(20);
    work();
    _exit(failures != 0);
  }
  int status = -1;
  return waitpid(child, &status, 0) == child && status == 0;
}

// A kernel that notes how many threads share each block, whose size in kB is its number of lanes.
std::size_t own_kilobytes(const Problem&, const Block& block) { return 1000 * static_cast<std::size_t>(block.count); }
std::atomic<int> done[65];  // by size of the team
void note(const Problem&, const Block&, Team& team, int rank, void*) {
  team.barrier();
  if (rank == 0) ++done[team.size()];
  team.barrier();
}

// How many of `count` blocks of so many kB were done by teams of 1, 2, 3 and 4 of four threads, with 1 MB of cache.
std::vector<int> teams_of(int kilobytes, int count, int domains) {
  const InstructionSet kernel{"test", 1, own_kilobytes, note};
  Plan plan{};
  plan.domains = domains;
  const Pack pack{&plan, nullptr};
  for (auto& size : done) size = 0;
  setenv("GMEM_CACHE", "1", 1);
  run_blocks(Problem{}, kernel,
             std::vector<Block>(count, {&pack, nullptr, nullptr, nullptr, nullptr, kilobytes, false}), 4);
  unsetenv("GMEM_CACHE");
  return {done[1], done[2], done[3], done[4]};
}

void blocks_run_side_by_side_as_far_as_they_fit_into_the_cache() {
  using Teams = std::vector<int>;
  CHECK((teams_of(100, 8, 64) == Teams{8, 0, 0, 0}));
  CHECK((teams_of(100, 9, 64) == Teams{8, 0, 0, 1}));  // what is left over is shared by all
  CHECK((teams_of(240, 4, 64) == Teams{0, 4, 0, 0}));
  CHECK((teams_of(600, 5, 64) == Teams{0, 0, 0, 5}));
  CHECK((teams_of(600, 1, 1) == Teams{1, 0, 0, 0}));
  CHECK((teams_of(600, 2, 2) == Teams{0, 2, 0, 0}));  // a block of two domains has no work for four
}

void a_bad_size_of_the_cache_is_refused() {
  for (const char* bad : {"0", "-1", "32M", "nan"}) {
    setenv("GMEM_CACHE", bad, 1);
    CHECK(thrown<std::invalid_argument>([] { cache_bytes(); }).find("GMEM_CACHE should be") == 0);
  }
  setenv("GMEM_CACHE", "32.5", 1);
  CHECK(cache_bytes() == 32500000);
  unsetenv("GMEM_CACHE");
  CHECK(cache_bytes() >= 100000);
}

void a_child_made_by_fork_has_threads_of_its_own() {
  const auto work = [] {
    const Threads held(3);
    std::atomic<int> ranks{0};
    Team team(held.count);
    run_ranks(held.count, [&](int) { team.run([&] { team.barrier(), ++ranks, team.barrier(); }); });
    CHECK(ranks == held.count);
    plan_for(Row().list());
  };
  CHECK(survives_a_fork(work));
  const Threads held(3);  // by the parent, whose call never ends as seen from the child
  CHECK(survives_a_fork([] { run_ranks(3, [](int) {}); }));
  const pid_t child = fork();
  if (child == 0) {
    alarm(20);
    const Threads own(3);
    _exit(own.count != 3);
  }
  int status = -1;
  CHECK(waitpid(child, &status, 0) == child && status == 0);
}

void a_bad_number_of_threads_is_refused() {
  for (const char* bad : {"0", "-2", "two", "2x", "1e3", "99999999999999999999"}) {
    setenv("GMEM_THREADS", bad, 1);
    CHECK(thrown<std::invalid_argument>([] { thread_count(); }).find("GMEM_THREADS should be") == 0);
  }
  setenv("GMEM_THREADS", "7", 1);
  CHECK(thread_count() == 7);
  unsetenv("GMEM_THREADS");
  CHECK(thread_count() >= 1);
}

int main() {
  a_child_made_by_fork_has_threads_of_its_own();
  a_bad_number_of_threads_is_refused();
  calls_at_once_share_out_the_cpus();
  a_failed_rank_is_thrown_when_all_have_ended();
  a_container_s_quota_is_found();
  a_team_does_not_wait_for_one_that_failed();
  every_chunk_of_a_phase_is_done_once();
  plans_keep_neighbours_together_and_padding_apart();
  lists_that_lead_astray_are_refused();
  a_failed_block_fails_the_call_and_not_the_next();
  blocks_run_side_by_side_as_far_as_they_fit_into_the_cache();
  a_bad_size_of_the_cache_is_refused();
  return failures != 0;
}
