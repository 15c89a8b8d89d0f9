// The arrays of a call: what they must be, and whether they are.

#pragma once

#include <array>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace gmem {

// One argument or result: its data, and how far apart the entries of each leading axis are.
struct Array {
  char* data = nullptr;
  std::vector<int64_t> step;  // of the leading axes, in elements; 0 where the array has size one

  int64_t at(const std::vector<int64_t>& index) const {
    int64_t offset = 0;
    for (std::size_t axis = 0; axis < index.size(); ++axis) offset += index[axis] * step[axis];
    return offset;
  }
};

// What an array must be. An axis is a digit, its length, or a letter; all axes of one letter are of one length.
struct Wanted {
  std::string name, axes;
  xla::ffi::DataType type = xla::ffi::F64;
};

inline void require(bool condition, const std::string& otherwise) {
  if (!condition) throw std::invalid_argument(otherwise);
}

// Looks at arrays one after the other; the first that has an axis says how long it is.
class Reader {
 public:
  explicit Reader(std::vector<int64_t> leading) : leading_(std::move(leading)) { sizes_.fill(-1); }

  int64_t& size(char letter) { return sizes_[static_cast<unsigned char>(letter) % sizes_.size()]; }

  // Throws std::invalid_argument if the array is not what it must be.
  Array read(const xla::ffi::AnyBuffer& buffer, const Wanted& wanted) {
    const auto dims = buffer.dimensions();
    const std::size_t leading = leading_.size();
    const auto expect = [&](bool condition, const std::string& otherwise) {
      if (!condition) throw std::invalid_argument(wanted.name + " " + shown(dims) + " " + otherwise);
    };
    expect(buffer.element_type() == wanted.type, "are numbers of the wrong type");
    expect(dims.size() == leading + wanted.axes.size(), "should be [" + wanted.axes + "]");
    Array array{static_cast<char*>(buffer.untyped_data()), std::vector<int64_t>(leading)};
    int64_t elements = 1;
    for (std::size_t axis = 0; axis < wanted.axes.size(); ++axis) {
      const char letter = wanted.axes[axis];
      const int64_t found = dims[leading + axis];
      int64_t& known = size(letter);
      if (letter <= '9') known = letter - '0';
      if (known < 0) known = found;
      expect(found == known, "should be [" + wanted.axes + "] with " + letter + " = " + std::to_string(known));
      expect(found < kLargest, "are too many");
      elements *= found;
    }
    for (int axis = static_cast<int>(leading) - 1; axis >= 0; --axis) {
      expect(dims[axis] == 1 || dims[axis] == leading_[axis], "do not have the leading axes of the others");
      array.step[axis] = dims[axis] == 1 ? 0 : elements;
      elements *= dims[axis];
    }
    return array;
  }

 private:
  // Numbers of rows, times those in a row, are integers of 32 bits.
  static constexpr int64_t kLargest = int64_t{1} << 27;

  static std::string shown(xla::ffi::AnyBuffer::Dimensions dims) {
    std::string text;
    for (const int64_t n : dims) text += (text.empty() ? "[" : ", ") + std::to_string(n);
    return text.empty() ? "[]" : text + "]";
  }

  std::vector<int64_t> leading_;
  std::array<int64_t, 128> sizes_;
};

}  // namespace gmem
