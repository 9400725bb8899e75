// As much of Arduino as the sketch uses, on a PC whose time and pins a test sets.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

constexpr int LOW = 0, HIGH = 1, INPUT_PULLUP = 2, CHANGE = 3;

extern uint32_t fake_us;
extern int fake_pins[8];
extern void (*fake_handlers[8])();

inline uint32_t micros() { return fake_us; }
inline int digitalRead(uint8_t pin) { return fake_pins[pin]; }
inline void pinMode(uint8_t, int) {}
inline int digitalPinToInterrupt(uint8_t pin) { return pin; }
inline void attachInterrupt(int pin, void (*handler)(), int) { fake_handlers[pin] = handler; }
inline void noInterrupts() {}
inline void interrupts() {}

struct FakeSerial {
  std::string out, in;
  int room = 1 << 20;
  void begin(uint32_t) {}
  int available() { return static_cast<int>(in.size()); }
  int read() {
    const int byte = static_cast<unsigned char>(in[0]);
    in.erase(0, 1);
    return byte;
  }
  int availableForWrite() { return room; }
  size_t write(const uint8_t *data, size_t length) {
    out.append(reinterpret_cast<const char *>(data), length);
    return length;
  }
};
extern FakeSerial Serial;
