// One replica: each vector is one number of W grains or of W contacts. Spheres, forces and histories are rows of four
// or eight doubles, which the contacts gather and turn into columns. Included inside the instruction set's namespace.

template <class Law>
struct Packed {
  using Row = double[4];

  const Problem& problem;
  const Block& block;
  const Lane& lane;
  Row* position;        // [S + 2]: sphere centres; the last two are far apart and fill up vectors
  Row* velocity;        // [S + 2]
  Row* spin;            // [N + 1]
  V* centres;           // [units, K, 3], for the grains
  double (*force)[8];   // [P + 1]: force on and torque about sphere i of each contact, where touched
  Row* history;         // [P + 1]
  double* layer;        // [P + 1, Q, 3] of the Mindlin law
  Marks marks;

  Packed(const Problem& problem, const Block& block) : problem(problem), block(block), lane(block.lanes[0]) {}

  static int units(const Problem& p) { return (p.grains + W - 1) / W; }
  static int unit_of(int grain) { return grain / W; }
  static int lane_of(int) { return 0; }

  static std::size_t carve(const Problem& p, Carver& carver, Packed* mode) {
    const std::size_t pairs = static_cast<std::size_t>(p.pairs) + 1;
    const std::size_t grains = static_cast<std::size_t>(units(p)) * W, spheres = grains * p.spheres_per_grain + 2;
    Row* position = carver.take<Row>(spheres);
    Row* velocity = carver.take<Row>(spheres);
    Row* spin = carver.take<Row>(grains + 1);
    V* centres = carver.take<V>(static_cast<std::size_t>(units(p)) * p.spheres_per_grain * 3);
    auto* force = carver.take<double[8]>(pairs);
    Row* history = carver.take<Row>(Law::kHistory ? pairs : 0);
    if (mode) {
      mode->position = position, mode->velocity = velocity, mode->spin = spin, mode->centres = centres;
      mode->force = force, mode->history = history;
    }
    carve_marks<Law>(p, carver, mode ? &mode->marks : nullptr);
    double* layer = carver.take<double>(Law::kLayered ? pairs * p.points * 3 : 0);
    if (mode) mode->layer = layer;
    return carver.used;
  }

  V per_lane(const double* Lane::*array, std::ptrdiff_t row) const { return splat((lane.*array)[row * problem.stride]); }

  // --- copying in and out

  void load_unit(int u, V* state) const {
    for (int l = 0; l < W; ++l) {
      const int g = u * W + l < problem.grains ? u * W + l : problem.grains - 1;
      for (int f = 0; f < kFields; ++f)
        for (int q = 0; q < kFieldSize[f]; ++q)
          state[static_cast<std::size_t>(u) * kSlots + kFieldSlot[f] + q][l] =
              lane.grains_in[f][(static_cast<std::ptrdiff_t>(g) * kFieldSize[f] + q) * problem.stride];
    }
  }

  void unload_unit(int u, const V* state, int) const {
    for (int l = 0; l < W && u * W + l < problem.grains; ++l)
      for (int f = 0; f < kFields; ++f)
        for (int q = 0; q < kFieldSize[f]; ++q)
          lane.grains_out[f][(static_cast<std::ptrdiff_t>(u * W + l) * kFieldSize[f] + q) * problem.stride] =
              state[static_cast<std::size_t>(u) * kSlots + kFieldSlot[f] + q][l];
  }

  void load_history(std::ptrdiff_t c) {
    marks.touched[c] = true;
    for (int q = 0; q < Law::kHistory; ++q) {
      const Place place = place_of<Law>(c, q);
      history[c][q] = lane.history_in[place.leaf][place.row * problem.stride];
    }
    if constexpr (Law::kLayered) {
      const int reached = layer_of(problem, lane, history[c][0]);
      marks.reached[c] = marks.reached_first[c] = reached;
      const std::ptrdiff_t first = c * problem.points * 3;
      for (int q = 0; q < 3 * (reached + 1); ++q) layer[first + q] = lane.history_in[0][(first + q) * problem.stride];
    }
  }

  void unload_history(std::ptrdiff_t c, int) const {
    for (int q = 0; q < Law::kHistory; ++q) {
      const Place place = place_of<Law>(c, q);
      lane.history_out[place.leaf][place.row * problem.stride] = history[c][q];
    }
    if constexpr (Law::kLayered) {
      const std::ptrdiff_t first = c * problem.points * 3;
      const int stored = 3 * (marks.reached[c] + 1);
      const int stale = 3 * (problem.history_aliased ? marks.reached_first[c] + 1 : problem.points);
      for (int q = 0; q < stored; ++q) lane.history_out[0][(first + q) * problem.stride] = layer[first + q];
      for (int q = stored; q < stale; ++q) lane.history_out[0][(first + q) * problem.stride] = 0.0;
    }
  }

  int dummy_sphere() const { return units(problem) * W * problem.spheres_per_grain; }
  int dummy_grain() const { return units(problem) * W; }

  void load_dummies() {
    for (int side = 0; side < 2; ++side) {
      for (int q = 0; q < 4; ++q) position[dummy_sphere() + side][q] = velocity[dummy_sphere() + side][q] = 0.0;
      position[dummy_sphere() + side][0] = 4.0 * side;
    }
    for (int q = 0; q < 4; ++q) spin[dummy_grain()][q] = 0.0;
    if constexpr (Law::kHistory > 0)
      for (int q = 0; q < 4; ++q) history[problem.pairs][q] = 0.0;
    if constexpr (Law::kLayered) marks.reached[problem.pairs] = -1;
  }

  // --- what the grains tell the contacts, and the contacts the grains

  static void put_rows(Row* rows, int stride, Vec a) {
    for (int l = 0; l < W; ++l) rows[l * stride][0] = a.x[l], rows[l * stride][1] = a.y[l], rows[l * stride][2] = a.z[l];
  }

  void put_spin(int u, Vec a) { put_rows(spin + static_cast<std::size_t>(u) * W, 1, a); }

  void put_sphere(int u, int k, Vec centre, Vec surface) {
    const int spheres = problem.spheres_per_grain;
    const std::size_t s = static_cast<std::size_t>(u) * W * spheres + k;
    put_rows(position + s, spheres, centre);
    put_rows(velocity + s, spheres, surface);
    store_vec(centres + 3 * (static_cast<std::size_t>(u) * spheres + k), centre);
  }

  Vec centre(int u, int k) const {
    return load_vec(centres + 3 * (static_cast<std::size_t>(u) * problem.spheres_per_grain + k));
  }

  bool contact_sum(int u, int k, Vec& f, Vec& t) const {
    alignas(64) double sums[W][8];
    bool any = false;
    for (int l = 0; l < W; ++l) {
      for (int q = 0; q < 8; ++q) sums[l][q] = 0.0;
      const int g = u * W + l;
      if (g >= problem.grains) continue;
      const std::size_t s = static_cast<std::size_t>(g) * problem.spheres_per_grain + k;
      const int32_t* row = block.pack->incidence + s * problem.per_sphere;
      for (int column = 0; column < problem.per_sphere && row[column] < 2 * problem.pairs; ++column) {
        const bool as_first = row[column] < problem.pairs;
        const std::size_t c = as_first ? row[column] : row[column] - problem.pairs;
        if (!marks.touched[c]) continue;
        any = true;
        const double* one = force[c];
        for (int q = 0; q < 3; ++q) sums[l][q] += as_first ? one[q] : -one[q];
        for (int q = 3; q < 6; ++q) sums[l][q] += one[q];
      }
    }
    for (int l = 0; l < W; ++l) {
      f.x[l] = sums[l][0], f.y[l] = sums[l][1], f.z[l] = sums[l][2];
      t.x[l] = sums[l][3], t.y[l] = sums[l][4], t.z[l] = sums[l][5];
    }
    return any;
  }

  void add_walls(int u, double* sums, Vec lower, Vec upper) const {
    const V parts[6] = {lower.x, lower.y, lower.z, upper.x, upper.y, upper.z};
    for (int l = 0; l < W && u * W + l < problem.grains; ++l)
      for (int q = 0; q < 6; ++q) sums[q] += parts[q][l];
  }

  Vec sum_walls(const double* walls, int chunks) const {
    double sums[6] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
      for (int q = 0; q < 6; ++q) sums[q] += walls[static_cast<std::size_t>(chunk) * 6 * W + q];
    return {splat(sums[0] + sums[3]), splat(sums[1] + sums[4]), splat(sums[2] + sums[5])};
  }

  // --- contacts

  struct Layers {
    double* at[W];
    int* last[W];
    int count;

    int points() const { return count; }
    Vec get(int j) const {
      Vec f{V{}, V{}, V{}};
      for (int l = 0; l < W; ++l)
        if (j <= *last[l]) f.x[l] = at[l][3 * j], f.y[l] = at[l][3 * j + 1], f.z[l] = at[l][3 * j + 2];
      return f;
    }
    Vec get_now(int j) const {
      Vec f;
      for (int l = 0; l < W; ++l) f.x[l] = at[l][3 * j], f.y[l] = at[l][3 * j + 1], f.z[l] = at[l][3 * j + 2];
      return f;
    }
    void set(int j, Vec f) {
      for (int l = 0; l < W; ++l) at[l][3 * j] = f.x[l], at[l][3 * j + 1] = f.y[l], at[l][3 * j + 2] = f.z[l];
    }
    void reached(int j) {
      for (int l = 0; l < W; ++l) *last[l] = j;
    }
  };

  void forget(std::size_t c) {
    marks.touched[c] = false;
    for (int q = 0; q < Law::kHistory; ++q) history[c][q] = 0.0;
    if constexpr (Law::kLayered) marks.reached[c] = -1;
  }

  // W sphere pairs and the differences of their rows.
  struct Group {
    int contact[W], one[W], other[W];
    alignas(64) double difference[W][4];

    void subtract(const Row* rows) {
      for (int l = 0; l < W; ++l)
        for (int q = 0; q < 4; ++q) difference[l][q] = rows[other[l]][q] - rows[one[l]][q];
    }
    void add(const Row* rows, const int* first, const int* second) {
      for (int l = 0; l < W; ++l)
        for (int q = 0; q < 4; ++q) difference[l][q] = rows[second[l]][q] + rows[first[l]][q];
    }
    Vec read() const {
      Vec a;
      columns(difference, a.x, a.y, a.z);
      return a;
    }
  };

  // First find which candidates touch, then compute those, W at a time.
  void contacts(int first, int end, const V* parameter, const LawParameters& law) {
    const Pack& pack = *block.pack;
    int touching[kChunkPairs + W];
    int count = 0;
    for (int start = first; start < end; start += W) {
      Group group;
      for (int l = 0; l < W; ++l) {
        const int c = start + l < end ? start + l : start;
        group.one[l] = pack.first[c];
        group.other[l] = pack.second[c];
      }
      group.subtract(position);
      const Vec separation = group.read();
      const unsigned near = bits_less(dot(separation, separation), splat(4.0));
      for (int l = 0; l < W && start + l < end; ++l) {
        const int c = start + l;
        const bool touches = (near >> l & 1u) && pack.valid[c];
        touching[count] = c;
        count += touches;
        if (touches) {
          marks.touched[c] = true;
        } else if (marks.touched[c]) {
          forget(c);
        }
      }
    }
    for (int start = 0; start < count; start += W) compute(touching + start, count - start, parameter, law);
  }

  void compute(const int* touching, int count, const V* parameter, const LawParameters& law) {
    Group group;
    int owner_one[W], owner_other[W];
    for (int l = 0; l < W; ++l) {
      const bool real = l < count;
      const int c = group.contact[l] = real ? touching[l] : problem.pairs;
      group.one[l] = real ? block.pack->first[c] : dummy_sphere();
      group.other[l] = real ? block.pack->second[c] : dummy_sphere() + 1;
      owner_one[l] = real ? problem.owner[group.one[l]] : dummy_grain();
      owner_other[l] = real ? problem.owner[group.other[l]] : dummy_grain();
    }
    group.subtract(position);
    const Vec separation = group.read();
    group.subtract(velocity);
    const Vec surface = group.read();
    group.add(spin, owner_one, owner_other);
    const Vec spin_sum = group.read();
    V memory[Law::kHistory + 1];
    for (int q = 0; q < Law::kHistory; ++q)
      for (int l = 0; l < W; ++l) memory[q][l] = history[group.contact[l]][q];
    Vec f, t;
    const V square = dot(separation, separation);
    if constexpr (Law::kLayered) {
      Layers layers;
      layers.count = problem.points;
      for (int l = 0; l < W; ++l) {
        layers.at[l] = layer + static_cast<std::size_t>(group.contact[l]) * problem.points * 3;
        layers.last[l] = marks.reached + group.contact[l];
      }
      contact_force<Law>(separation, square, surface, spin_sum, parameter, law, memory, layers, f, t);
    } else {
      NoLayers none;
      contact_force<Law>(separation, square, surface, spin_sum, parameter, law, memory, none, f, t);
    }
    for (int l = 0; l < W; ++l) {
      double* row = force[group.contact[l]];
      row[0] = f.x[l], row[1] = f.y[l], row[2] = f.z[l], row[3] = t.x[l], row[4] = t.y[l], row[5] = t.z[l];
    }
    for (int q = 0; q < Law::kHistory; ++q)
      for (int l = 0; l < W; ++l) history[group.contact[l]][q] = memory[q][l];
  }
};
