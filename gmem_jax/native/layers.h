// The Mindlin law with its whole history: f on Q points, of which a contact that reaches to x = sqrt(p) / dq carries
// force in those up to `outer`. Here the lanes of the CPU are points of one contact. Included inside the instruction
// set's namespace.

constexpr int kTile = 8;  // points are stored, and their forces summed, in as many rows on every CPU

inline int whole_tiles(int points) { return (points + kTile - 1) / kTile * kTile; }

// The f of one contact, a row for each component. Points from `stored`, a multiple of kTile, on are zero.
struct Layers {
  double* at;
  int row;  // distance of the components: Q in whole tiles
  int* stored;

  Vec load(int j) const { return {GMEM_ISA::load(at + j), GMEM_ISA::load(at + row + j), GMEM_ISA::load(at + 2 * row + j)}; }
  void store(int j, Vec f) const {
    GMEM_ISA::store(at + j, f.x);
    GMEM_ISA::store(at + row + j, f.y);
    GMEM_ISA::store(at + 2 * row + j, f.z);
  }
};

// How far contacts reach: `x` rings, the outermost number `outer` filled in part.
struct Reach {
  V x, outer;

  Reach(V root_overlap, const LawParameters& law, int points) : x(root_overlap * law.inverse_spacing) {
    const V last = splat(points - 2.0);
    outer = select(x < last, floor_of(select(x < last, x, V{})), last);
  }

  // How much the points `j` of contact `lane` count.
  V weight(int lane, V j) const {
    const V last = splat(outer[lane]);
    return zero_unless(j <= last, select(j < last, splat(1.0), splat(x[lane]) - j));
  }
};

// Contact number `lane` of a vector of contacts, in every lane.
GMEM_INLINE Vec spread(const Vec& a, int lane) { return {splat(a.x[lane]), splat(a.y[lane]), splat(a.z[lane])}; }

// Numbers of the points j, j + 1, ...
inline V points_from(int j) {
  V at;
  for (int l = 0; l < W; ++l) at[l] = j + l;
  return at;
}

// The friction of W contacts, of which the first `count` are real. Their points are cut into pieces of W, which go
// through the passes together, for the same reason as contacts do.
class LayeredFriction {
 public:
  LayeredFriction(Contact& c, int count, const LawParameters& law, int points, Variant variant)
      : law_(law), variant_(variant), contact_(c), count_(count), transport_(c), now_(c.root_overlap, law, points),
        past_(variant == Variant::averaged ? root(c.history[0]) : V{}, law, points), half_step_(law.half_step * c.sliding) {
    const V half = splat(0.5);
    const bool paper = variant == Variant::paper;  // its weights sum to x - 1/2; where that is negative it has no spring
    attached_ = paper ? now_.x > half : now_.x == now_.x;
    total_ = paper ? select(attached_, now_.x - half, splat(1.0)) : now_.x;
  }

  template <class LayersOf>
  void run(const LayersOf& layers_of) {
    pieces_ = 0;
    for (int l = 0; l < count_; ++l) {
      layers_[l] = layers_of(l);
      end_[l] = contact_.overlap[l] > 0.0 ? static_cast<int>(now_.outer[l]) + 1 : 0;
      filled_[l] = !attached_[l] ? 0 : static_cast<int>(variant_ == Variant::averaged && past_.outer[l] < now_.outer[l]
                                                            ? past_.outer[l] : now_.outer[l]);
      for (Vec& part : sum_[l]) part = Vec{V{}, V{}, V{}};
      const int kept = whole_tiles(end_[l]);
      for (int j = *layers_[l].stored; j < kept; j += W) layers_[l].store(j, Vec{V{}, V{}, V{}});
      *layers_[l].stored = kept;
      for (int j = 0; j < kept; j += W) {
        piece_[pieces_++] = {l, j};
        if (pieces_ == kPieces) carry();
      }
    }
    carry();
    Vec sum{V{}, V{}, V{}};
    for (int l = 0; l < count_; ++l) {
      for (int q = 0; q < kTile; ++q) {
        const Vec& part = sum_[l][q / W];
        sum.x[l] += part.x[q % W], sum.y[l] += part.y[q % W], sum.z[l] += part.z[q % W];
      }
    }
    const Vec trial = fma(law_.spacing, sum, (law_.dashpot * contact_.root_overlap) * contact_.sliding);
    contact_.force = trial;
    coulomb(&contact_, 1, law_.mu);
    correct(fma(splat(1.0) / (law_.spacing * total_), contact_.force - trial, half_step_));
    contact_.history[0] = zero_unless(contact_.touching(), contact_.overlap);
  }

 private:
  static constexpr int kPieces = 64;

  struct Piece {
    int lane, j;
  };

  Transport transport_of(int lane) const {
    Transport t = transport_;
    t.normal = spread(transport_.normal, lane);
    t.cosine = splat(transport_.cosine[lane]);
    t.sine = splat(transport_.sine[lane]);
    t.denominator2 = splat(transport_.denominator2[lane]);
    return t;
  }

  // Carries the points of all pieces along, adds half a step and sums their forces.
  void carry() {
    for (int n = 0; n < pieces_; ++n) {
      const Piece p = piece_[n];
      f_[n] = layers_[p.lane].load(p.j);
      square_[n] = transport_of(p.lane).flatten(f_[n], before_[n]);
    }
    for (int n = 0; n < pieces_; ++n) inverse_[n] = inverse_root(square_[n]);
    for (int n = 0; n < pieces_; ++n) {
      const Piece p = piece_[n];
      const Vec carried = transport_of(p.lane).restore(f_[n], before_[n], square_[n], inverse_[n]);
      Vec& sum = sum_[p.lane][p.j / W % (kTile / W)];
      if (p.j + W <= filled_[p.lane] && (p.j > 0 || variant_ != Variant::paper)) {
        const Vec now = carried + spread(half_step_, p.lane);
        sum = sum + now;
        layers_[p.lane].store(p.j, now);
      } else {
        layers_[p.lane].store(p.j, add_edge(p, carried, sum));
      }
    }
    pieces_ = 0;
  }

  // The same for points around the outermost ring, which is filled in part.
  Vec add_edge(Piece p, Vec carried, Vec& sum) const {
    const V one = splat(1.0), at = points_from(p.j);
    V weight = now_.weight(p.lane, at);
    if (variant_ == Variant::averaged) {  // the force in a ring that fills stays
      const V filled = past_.weight(p.lane, at);
      const Mask grows = filled < weight;
      carried = select(grows, filled / select(grows, weight, one), one) * carried;
    }
    if (variant_ == Variant::paper) weight = weight - zero_unless(at < one, splat(0.5));
    const Mask inside = at < splat(attached_[p.lane] ? end_[p.lane] : 0);
    const Vec now = zero_unless(inside, carried + spread(half_step_, p.lane));
    sum = fma(zero_unless(inside, weight), now, sum);
    return now;
  }

  void correct(Vec correction) const {
    for (int l = 0; l < count_; ++l) {
      if (!attached_[l]) continue;
      const Vec one = spread(correction, l);
      const V end = splat(end_[l]);
      int j = 0;
      for (; j + W <= end_[l]; j += W) layers_[l].store(j, layers_[l].load(j) + one);
      if (j < end_[l]) layers_[l].store(j, layers_[l].load(j) + zero_unless(points_from(j) < end, one));
    }
  }

  const LawParameters& law_;
  const Variant variant_;
  Contact& contact_;
  const int count_;
  const Transport transport_;
  const Reach now_, past_;  // past: at the last step
  const Vec half_step_;
  Mask attached_;           // whether the points of a contact carry force
  V total_;                 // of their weights
  Layers layers_[W];
  int end_[W];              // points that are kept
  int filled_[W];           // those of rings that are filled, and were
  Vec sum_[W][kTile / W];
  int pieces_ = 0;
  Piece piece_[kPieces];
  Vec f_[kPieces];
  V before_[kPieces], square_[kPieces], inverse_[kPieces];
};
