// The E-line protocol at the board's end, and the decoder of the encoder's two lines.
//
// Plain C++11 without Arduino, without dynamic memory and without printf: the same source runs on an
// 8-bit AVR, a Pico, a Teensy, and on a PC, where the tests compare it byte by byte with
// src/equipoise/devices/encoder/codec.py. docs/reference/e-line.md describes the protocol.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace eline {

// Bytes of the longest line, its end included. No terminating zero is written.
constexpr size_t kLongest = 97;

enum Flags : uint8_t {
  kDown = 1,     // the button is down
  kPressed = 2,  // it was pressed since the line before
  kIndex = 4,    // the index was seen since the line before
  kIllegal = 8,  // both lines changed at once since the line before
};

struct Reading {
  uint16_t seq;    // number of the period since the start, modulo 2^16
  uint32_t t_us;   // micros() when the count was taken
  int32_t counts;  // after x4, since the start; never set to zero
  uint8_t flags;   // Flags, 0 to 15
};

// CRC-8/MAXIM: polynomial 0x31, least bit first, from zero.
uint8_t crc8(const char *data, size_t length);

// Write a line with its end; return its length. `out` has room for kLongest bytes.
size_t format_reading(char *out, const Reading &reading);

// The same for the banner. name: a letter, then up to 31 letters, digits, _ or -; firmware: up to 16
// letters, digits, dots, _ or -; counts_per_rev below 1e9, rate_hz below 1e6, neither zero.
// Returns 0 where one of them does not fit.
size_t format_banner(char *out, const char *name, const char *firmware, uint32_t counts_per_rev,
                     uint32_t rate_hz);

// Finds the host's question, `?` alone on a line.
class Requests {
 public:
  // Take a byte; return whether it completes a question.
  bool feed(char byte);

 private:
  uint8_t line_ = 0;  // 0: nothing yet, 1: a question mark, 2: anything else
};

// Decodes the encoder's lines A and B: four counts per period, +1 where A leads B.
class Quadrature {
 public:
  // Begin with the lines as they are; bit 1 is A, bit 0 is B.
  explicit Quadrature(uint8_t ab = 0) : ab_(ab & 3) {}

  // Take the lines after an edge. Where both have changed, which way is unknown: no count, a flag.
  void step(uint8_t ab);

  int32_t counts() const { return static_cast<int32_t>(counts_); }

  // Whether an illegal transition was met since it was last asked and told.
  bool illegal() const { return illegal_; }
  void told() { illegal_ = false; }

 private:
  uint32_t counts_ = 0;  // unsigned, so that it wraps as defined
  uint8_t ab_;
  bool illegal_ = false;
};

// Tells when a line is due, at a fixed rate that no lateness shifts.
class Pace {
 public:
  Pace(uint32_t period_us, uint32_t now_us) : period_us_(period_us), next_us_(now_us + period_us) {}

  // Return how many periods have ended since the last call: usually none or one. More than one means
  // that the board was late; the sequence counts those, too, so that the host sees them missing.
  uint16_t due(uint32_t now_us);

 private:
  uint32_t period_us_;
  uint32_t next_us_;
};

}  // namespace eline
