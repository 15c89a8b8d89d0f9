// The contact laws, term by term those of gmem_jax/contact. Included inside the instruction set's namespace.

struct Contact {
  Mask touching;
  Vec normal;   // from i to j
  V overlap;    // 1 where apart, so that roots stay finite
  Vec sliding;  // relative velocity of the surfaces in the tangent plane
  V cosine, sine;  // of the turn about the normal in this step
  V dt;
};

struct LawParameters {
  V mu, stiffness, damping_time, spacing, inverse_spacing;
};

// f = k p^1.5 + gamma p^0.5 dp/dt, never attractive.
inline V hertz(Mask touching, V overlap, V closing, V stiffness, V damping_time) {
  const V force = stiffness * root(overlap) * fma(damping_time, closing, overlap);
  return zero_unless(touching & (force > V{}), force);
}

// Carry a tangential force along: project, restore the magnitude, turn about the normal.
inline Vec transport(const Contact& c, Vec force) {
  const Vec flat = fnma(dot(force, c.normal), c.normal, force);
  const V before = dot(force, force);
  const V product = before * dot(flat, flat);
  // Forces below 1e-70, whose squares would underflow, are not worth a magnitude.
  const V stretch = select(product > splat(1e-280), before * inverse_root(product), splat(1.0));
  const V along = stretch * c.cosine, across = stretch * c.sine;
  return fma(across, cross(c.normal, flat), along * flat);
}

// The factor that takes a trial force back to the friction limit.
inline V coulomb(Vec trial, V limit) {
  const V square = dot(trial, trial), square_limit = limit * limit;
  if (!bits_less(square_limit, square)) return splat(1.0);
  const Mask slides = square > square_limit;
  return select(slides, limit * inverse_root(select(slides, square, splat(1.0))), splat(1.0));
}

struct Frictionless {
  static constexpr int kHistory = 0;  // numbers remembered of a contact, beside Mindlin's layers
  static constexpr int kVectors = 0;  // those of them that are components of forces
  static constexpr bool kLayered = false;
};

struct Hooke {
  static constexpr int kHistory = 3;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

struct Rescaled {
  static constexpr int kHistory = 4;  // force, overlap
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

template <Variant variant_>
struct Layered {
  static constexpr int kHistory = 1;  // overlap; the layers are kept apart
  static constexpr int kVectors = 0;
  static constexpr bool kLayered = true;
  static constexpr Variant variant = variant_;
};

struct NoLayers {};

inline Vec friction(Frictionless, const Contact&, V, const LawParameters&, V*, NoLayers&) { return {V{}, V{}, V{}}; }

inline Vec friction(Hooke, const Contact& c, V normal_force, const LawParameters& law, V* history, NoLayers&) {
  const V half = splat(0.5) * law.stiffness * c.dt;
  const V damping = law.stiffness * law.damping_time;
  const Vec elastic = fma(half, c.sliding, transport(c, load_vec(history)));
  const Vec trial = fma(damping, c.sliding, elastic);
  const Vec force = zero_unless(c.touching, coulomb(trial, law.mu * normal_force) * trial);
  store_vec(history, zero_unless(c.touching, fma(half - damping, c.sliding, force)));
  return force;
}

inline Vec friction(Rescaled, const Contact& c, V normal_force, const LawParameters& law, V* history, NoLayers&) {
  const V one = splat(1.0);
  const Mask unloads = c.touching & (c.overlap < history[3]);
  const V spring = law.stiffness * root(c.overlap);
  const V half = splat(0.5) * c.dt * spring;
  const V damping = law.damping_time * spring;
  const V ratio = root(select(unloads, c.overlap, one) / select(unloads, history[3], one));
  const Vec elastic = fma(half, c.sliding, ratio * transport(c, load_vec(history)));
  const Vec trial = fma(damping, c.sliding, elastic);
  const Vec force = zero_unless(c.touching, coulomb(trial, law.mu * normal_force) * trial);
  store_vec(history, zero_unless(c.touching, fma(half - damping, c.sliding, force)));
  history[3] = zero_unless(c.touching, c.overlap);
  return force;
}

// Where a contact stands in its rings: `x` rings reached, the outermost number `outer` filled in part.
struct Reach {
  V x, outer;
};

inline Reach reach(V root_overlap, const LawParameters& law, int points) {
  const V x = root_overlap * law.inverse_spacing;
  const V last = splat(points - 2.0);
  return {x, select(x < last, floor_of(select(x < last, x, V{})), last)};
}

// How much point `j` counts, by "exact" weights.
inline V weight(const Reach& r, V j) {
  return zero_unless(j <= r.outer, select(j < r.outer, splat(1.0), r.x - j));
}

// Layers: `get(j)`, `set(j, f)`; `reached()`: all layers beyond are zero, in `get` too; `reached(jmax)`.
template <Variant variant, class Layers>
inline Vec friction(Layered<variant>, const Contact& c, V normal_force, const LawParameters& law, V* history,
                    Layers& layers) {
  const V one = splat(1.0);
  const V root_overlap = root(c.overlap);
  const Reach now = reach(root_overlap, law, layers.points());
  const Vec half_step = (splat(0.5) * law.stiffness * c.dt) * c.sliding;
  const Vec dashpot = (law.stiffness * law.damping_time * root_overlap) * c.sliding;
  Mask attached = c.touching;
  V total = now.x;
  if (variant == Variant::paper) {
    attached &= now.x > splat(0.5);
    total = select(now.x > splat(0.5), now.x - splat(0.5), one);
  }
  Reach before{V{}, V{}};
  if (variant == Variant::averaged) before = reach(root(history[0]), law, layers.points());

  // Rings below `plain` are whole in every lane, before and now, and need no masks.
  const int end = static_cast<int>(largest(zero_unless(c.touching, now.outer))) + 1;
  const bool all = !bits_less(zero_unless(attached, one), one);
  int plain = all ? static_cast<int>(smallest(now.outer)) : 0;
  if (variant == Variant::averaged) plain = plain < static_cast<int>(smallest(before.outer)) ? plain : static_cast<int>(smallest(before.outer));
  Vec sum{V{}, V{}, V{}};
  int j = 0;
  if (variant == Variant::paper && plain > 0) {
    const Vec f = transport(c, layers.get(0)) + half_step;
    layers.set(0, f);
    sum = splat(0.5) * f;
    j = 1;
  }
  for (; j < plain; ++j) {
    const Vec f = transport(c, layers.get(j)) + half_step;
    layers.set(j, f);
    sum = sum + f;
  }
  for (; j < end; ++j) {
    const V at = splat(j);
    V w = weight(now, at);
    Vec f = transport(c, layers.get(j));
    if (variant == Variant::averaged) {
      const V filled = weight(before, at);
      const Mask grows = filled < w;
      f = select(grows, filled / select(grows, w, one), one) * f;
    }
    if (variant == Variant::paper && j == 0) w = w - splat(0.5);
    const Mask inside = attached & (at <= now.outer);
    f = zero_unless(inside, f + half_step);
    layers.set(j, f);
    sum = fma(zero_unless(inside, w), f, sum);
  }
  const Vec trial = fma(law.spacing, sum, dashpot);
  const V scale = coulomb(trial, law.mu * normal_force);
  const Vec force = scale * trial;
  const Vec correction = fma(V{} + one / (law.spacing * total), force - trial, half_step);
  for (j = 0; j < plain; ++j) layers.set(j, layers.get_now(j) + correction);
  for (; j < end; ++j) {
    const Mask inside = attached & (splat(j) <= now.outer);
    layers.set(j, zero_unless(inside, layers.get_now(j) + correction));
  }
  layers.reached(end - 1);
  history[0] = zero_unless(c.touching, c.overlap);
  return zero_unless(c.touching, force);
}
