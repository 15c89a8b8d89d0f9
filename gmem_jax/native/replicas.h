// W replicas of a pack side by side: each vector is one number of one grain or contact. Included inside the
// instruction set's namespace; see `Engine` in block.h for how it is used.

template <class Law>
struct Replicas {
  const Problem& problem;
  const Block& block;
  bool adjacent;   // the lanes are W neighbours in every array of the call
  V* sphere;       // [S, 6]: centre, its velocity
  V* spin;         // [N, 3]
  V* force;        // [P, 6]: force on and torque about sphere i of each contact, where touched
  V* history;      // [P, Law::kHistory]
  V* layer;        // [P, Q, 3] of the Mindlin law
  Marks marks;

  Replicas(const Problem& problem, const Block& block) : problem(problem), block(block) {
    adjacent = block.count == W;
    const Lane& a = block.lanes[0];
    for (int l = 1; l < block.count; ++l) {
      const Lane& b = block.lanes[l];
      for (int f = 0; f < kFields; ++f)
        adjacent &= b.grains_in[f] == a.grains_in[f] + l && b.grains_out[f] == a.grains_out[f] + l;
      for (int leaf = 0; leaf < kMaxHistory; ++leaf)
        if (a.history_in[leaf])
          adjacent &= b.history_in[leaf] == a.history_in[leaf] + l && b.history_out[leaf] == a.history_out[leaf] + l;
    }
  }

  static int units(const Problem& p) { return p.grains; }
  static int unit_of(int grain) { return grain; }
  static int lane_of(int l) { return l; }

  static std::size_t carve(const Problem& p, Carver& carver, Replicas* mode) {
    const std::size_t pairs = p.pairs;
    V* sphere = carver.take<V>(static_cast<std::size_t>(p.spheres()) * 6);
    V* spin = carver.take<V>(static_cast<std::size_t>(p.grains) * 3);
    V* force = carver.take<V>(pairs * 6);
    V* history = carver.take<V>(pairs * Law::kHistory);
    if (mode) mode->sphere = sphere, mode->spin = spin, mode->force = force, mode->history = history;
    carve_marks<Law>(p, carver, mode ? &mode->marks : nullptr);
    V* layer = carver.take<V>(Law::kLayered ? pairs * p.points * 3 : 0);
    if (mode) mode->layer = layer;
    return carver.used;
  }

  // A short block repeats its last replica.
  const Lane& lane(int l) const { return block.lanes[l < block.count ? l : block.count - 1]; }

  V per_lane(const double* Lane::*array, std::ptrdiff_t row) const {
    V a;
    for (int l = 0; l < W; ++l) a[l] = (lane(l).*array)[row * problem.stride];
    return a;
  }

  // --- copying in and out

  template <class Pointer>
  V read(const Pointer& pointer, std::ptrdiff_t row) const {
    if (adjacent) return load(pointer(block.lanes[0]) + row * problem.stride);
    V a;
    for (int l = 0; l < W; ++l) a[l] = pointer(lane(l))[row * problem.stride];
    return a;
  }

  // Only lanes that have done all their steps.
  template <class Pointer>
  void write(const Pointer& pointer, std::ptrdiff_t row, V a, int steps_done) const {
    int ends = 0;
    for (int l = 0; l < block.count; ++l) ends += block.lanes[l].steps == steps_done;
    if (adjacent && ends == W) return store(pointer(block.lanes[0]) + row * problem.stride, a);
    for (int l = 0; l < block.count; ++l)
      if (block.lanes[l].steps == steps_done) pointer(block.lanes[l])[row * problem.stride] = a[l];
  }

  void load_unit(int u, V* state) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kFieldSize[f]; ++q)
        state[static_cast<std::size_t>(u) * kSlots + kFieldSlot[f] + q] = read(
            [f](const Lane& lane) { return lane.grains_in[f]; }, static_cast<std::ptrdiff_t>(u) * kFieldSize[f] + q);
  }

  void unload_unit(int u, const V* state, int steps_done) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kFieldSize[f]; ++q)
        write([f](const Lane& lane) { return lane.grains_out[f]; }, static_cast<std::ptrdiff_t>(u) * kFieldSize[f] + q,
              state[static_cast<std::size_t>(u) * kSlots + kFieldSlot[f] + q], steps_done);
  }

  void load_history(std::ptrdiff_t c) {
    marks.touched[c] = true;
    for (int q = 0; q < Law::kHistory; ++q) {
      const Place place = place_of<Law>(c, q);
      history[c * Law::kHistory + q] =
          read([place](const Lane& lane) { return lane.history_in[place.leaf]; }, place.row);
    }
    if constexpr (Law::kLayered) {
      int reached = -1;
      for (int l = 0; l < block.count; ++l) {
        const int of_lane = layer_of(problem, block.lanes[l], history[c][l]);
        reached = of_lane > reached ? of_lane : reached;
      }
      marks.reached[c] = marks.reached_first[c] = reached;
      const std::ptrdiff_t first = c * problem.points * 3;
      for (int q = 0; q < 3 * (reached + 1); ++q)
        layer[first + q] = read([](const Lane& lane) { return lane.history_in[0]; }, first + q);
    }
  }

  void unload_history(std::ptrdiff_t c, int steps_done) const {
    for (int q = 0; q < Law::kHistory; ++q) {
      const Place place = place_of<Law>(c, q);
      write([place](const Lane& lane) { return lane.history_out[place.leaf]; }, place.row,
            history[c * Law::kHistory + q], steps_done);
    }
    if constexpr (Law::kLayered) {
      const std::ptrdiff_t first = c * problem.points * 3;
      const auto out = [](const Lane& lane) { return lane.history_out[0]; };
      const int stored = 3 * (marks.reached[c] + 1);
      const int stale = 3 * (problem.history_aliased ? marks.reached_first[c] + 1 : problem.points);
      for (int q = 0; q < stored; ++q) write(out, first + q, layer[first + q], steps_done);
      for (int q = stored; q < stale; ++q) write(out, first + q, V{}, steps_done);
    }
  }

  // --- what the grains tell the contacts, and the contacts the grains

  void put_spin(int u, Vec a) { store_vec(spin + 3 * static_cast<std::size_t>(u), a); }

  void put_sphere(int u, int k, Vec centre, Vec velocity) {
    V* row = sphere + 6 * (static_cast<std::size_t>(u) * problem.spheres_per_grain + k);
    store_vec(row, centre);
    store_vec(row + 3, velocity);
  }

  Vec centre(int u, int k) const {
    return load_vec(sphere + 6 * (static_cast<std::size_t>(u) * problem.spheres_per_grain + k));
  }

  // Sum of the contacts of sphere k of unit u; false if it has none.
  bool contact_sum(int u, int k, Vec& f, Vec& t) const {
    const std::size_t s = static_cast<std::size_t>(u) * problem.spheres_per_grain + k;
    const int32_t* row = block.pack->incidence + s * problem.per_sphere;
    f = t = Vec{V{}, V{}, V{}};
    bool any = false;
    for (int column = 0; column < problem.per_sphere && row[column] < 2 * problem.pairs; ++column) {
      const bool as_first = row[column] < problem.pairs;
      const std::size_t c = as_first ? row[column] : row[column] - problem.pairs;
      if (!marks.touched[c]) continue;
      any = true;
      const Vec one = load_vec(force + 6 * c);
      f = as_first ? f + one : f - one;
      t = t + load_vec(force + 6 * c + 3);
    }
    return any;
  }

  void add_walls(int, double* sums, Vec lower, Vec upper) const {
    V* s = reinterpret_cast<V*>(sums);
    store_vec(s, load_vec(s) + lower);
    store_vec(s + 3, load_vec(s + 3) + upper);
  }

  Vec sum_walls(const double* walls, int chunks) const {
    const V* s = reinterpret_cast<const V*>(walls);
    Vec lower{V{}, V{}, V{}}, upper = lower;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      lower = lower + load_vec(s + 6 * chunk);
      upper = upper + load_vec(s + 6 * chunk + 3);
    }
    return lower + upper;
  }

  // --- contacts

  struct Layers {
    V* at;
    int* last;
    int count;

    int points() const { return count; }
    Vec get(int j) const { return j <= *last ? load_vec(at + 3 * j) : Vec{V{}, V{}, V{}}; }
    Vec get_now(int j) const { return load_vec(at + 3 * j); }
    void set(int j, Vec f) { store_vec(at + 3 * j, f); }
    void reached(int j) { *last = j; }
  };

  void forget(std::size_t c) {
    for (int q = 0; q < Law::kHistory; ++q) history[c * Law::kHistory + q] = V{};
    if constexpr (Law::kLayered) marks.reached[c] = -1;
  }

  // First find which candidates touch, then compute those: the processor can run ahead in a loop without surprises.
  void contacts(int first, int end, const V* parameter, const LawParameters& law) {
    const Pack& pack = *block.pack;
    const V contact_square = splat(4.0);
    int touching[kChunkPairs + 1], count = 0;
    for (int c = first; c < end; ++c) {
      const Vec separation = load_vec(sphere + 6 * static_cast<std::size_t>(pack.second[c])) -
                             load_vec(sphere + 6 * static_cast<std::size_t>(pack.first[c]));
      const bool touches = bits_less(dot(separation, separation), contact_square) && pack.valid[c];
      if (marks.touched[c] && !touches) forget(c);
      marks.touched[c] = touches;
      touching[count] = c;
      count += touches;
    }
    for (int n = 0; n < count; ++n) compute(touching[n], parameter, law);
  }

  void compute(std::size_t c, const V* parameter, const LawParameters& law) {
    const int i = block.pack->first[c], j = block.pack->second[c];
    const V *one = sphere + 6 * static_cast<std::size_t>(i), *other = sphere + 6 * static_cast<std::size_t>(j);
    const Vec separation = load_vec(other) - load_vec(one);
    const Vec velocity = load_vec(other + 3) - load_vec(one + 3);
    const Vec spin_sum = load_vec(spin + 3 * problem.owner[j]) + load_vec(spin + 3 * problem.owner[i]);
    V* memory = history + c * Law::kHistory;
    Vec f, t;
    const V square = dot(separation, separation);
    if constexpr (Law::kLayered) {
      Layers layers{layer + c * problem.points * 3, marks.reached + c, problem.points};
      contact_force<Law>(separation, square, velocity, spin_sum, parameter, law, memory, layers, f, t);
    } else {
      NoLayers none;
      contact_force<Law>(separation, square, velocity, spin_sum, parameter, law, memory, none, f, t);
    }
    store_vec(force + 6 * c, f);
    store_vec(force + 6 * c + 3, t);
  }

  void load_dummies() {}
};
