// Objects of which a process has one.

#pragma once

#include <pthread.h>

namespace gmem {

// The one T of this process, never destroyed: threads outlive static destruction. A child made by fork gets a new one,
// because threads do not come along, and a lock that one of them held would never be released.
template <class T>
T& of_process() {
  static T* one = [] {
    pthread_atfork(nullptr, nullptr, [] { one = new T; });
    return new T;
  }();
  return *one;
}

}  // namespace gmem
