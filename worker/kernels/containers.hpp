// An array that grows, a stable order, and a queue that gives the least first.
#pragma once
#include "lanes.hpp"

template <class T>
class Growing {
 public:
  ~Growing() { free(begin_); }
  Growing() = default;
  Growing(const Growing&) = delete;
  Growing& operator=(const Growing&) = delete;
  void add(const T& value) {
    if (count_ == room_) {
      room_ = greater(2 * room_, int64_t{64});
      begin_ = static_cast<T*>(realloc(begin_, room_ * sizeof(T)));
    }
    begin_[count_++] = value;
  }
  void remove_last() { --count_; }
  void clear() { count_ = 0; }
  int64_t count() const { return count_; }
  T& operator[](int64_t k) { return begin_[k]; }

 private:
  T* begin_ = nullptr;
  int64_t count_ = 0, room_ = 0;
};

// Puts numbers in the order of their keys; equal ones keep their order (merge sort). `room` has as many.
template <class Key>
void sort_stably(int64_t* order, int64_t count, int64_t* room, const Key& key) {
  if (count <= 16) {
    for (int64_t i = 1; i < count; ++i) {
      const int64_t own = order[i];
      int64_t to = i;
      for (; to > 0 && key(own) < key(order[to - 1]); --to) order[to] = order[to - 1];
      order[to] = own;
    }
    return;
  }
  const int64_t half = count / 2;
  sort_stably(order, half, room, key);
  sort_stably(order + half, count - half, room, key);
  memcpy(room, order, half * sizeof(int64_t));
  for (int64_t i = 0, j = half, to = 0; i < half; ++to)
    order[to] = j < count && key(order[j]) < key(room[i]) ? order[j++] : room[i++];
}

// Waiting numbers, the one of the least value first; of equal values the least number.
class Queue {
 public:
  bool is_empty() { return items_.count() == 0; }
  void clear() { items_.clear(); }
  void add(double value, int64_t number) {
    items_.add({value, number});
    for (int64_t k = items_.count() - 1; k > 0 && is_before(k, (k - 1) / 2); k = (k - 1) / 2) swap(k, (k - 1) / 2);
  }
  int64_t take(double& value) {
    const Item first = items_[0];
    items_[0] = items_[items_.count() - 1];
    items_.remove_last();
    for (int64_t k = 0;;) {
      int64_t least = k;
      for (int64_t child = 2 * k + 1; child <= 2 * k + 2 && child < items_.count(); ++child)
        if (is_before(child, least)) least = child;
      if (least == k) break;
      swap(k, least);
      k = least;
    }
    value = first.value;
    return first.number;
  }

 private:
  struct Item { double value; int64_t number; };
  bool is_before(int64_t a, int64_t b) {
    return items_[a].value < items_[b].value || (items_[a].value == items_[b].value && items_[a].number < items_[b].number);
  }
  void swap(int64_t a, int64_t b) {
    const Item own = items_[a];
    items_[a] = items_[b];
    items_[b] = own;
  }
  Growing<Item> items_;
};
