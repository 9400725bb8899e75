// The whole sketch on a PC: pins, time and bytes come from standard input.
#include "Arduino.h"

#include <cstdio>
#include <cstring>

uint32_t fake_us = 0;
int fake_pins[8] = {0, 0, 1, 1, 1, 1, 1, 1};
void (*fake_handlers[8])() = {};
FakeSerial Serial;

#include "equipoise_encoder.ino"

int main() {
  char command[8];
  while (std::scanf("%7s", command) == 1) {
    unsigned a = 0, b = 0;
    if (!std::strcmp(command, "boot")) {
      if (std::scanf("%u", &a) != 1) return 1;
      fake_us = a;
      setup();
    } else if (!std::strcmp(command, "at")) {
      if (std::scanf("%u", &a) != 1) return 1;
      fake_us = a;
      loop();
    } else if (!std::strcmp(command, "pin")) {
      if (std::scanf("%u %u", &a, &b) != 2) return 1;
      fake_pins[a] = static_cast<int>(b);
      if (fake_handlers[a]) fake_handlers[a]();
    } else if (!std::strcmp(command, "both")) {
      // Both lines change before the board sees it: an edge was missed.
      fake_pins[PIN_A] ^= 1;
      fake_pins[PIN_B] ^= 1;
      fake_handlers[PIN_A]();
    } else if (!std::strcmp(command, "room")) {
      if (std::scanf("%u", &a) != 1) return 1;
      Serial.room = static_cast<int>(a);
    } else if (!std::strcmp(command, "ask")) {
      Serial.in += "?\n";
    } else {
      return 1;
    }
  }
  std::fwrite(Serial.out.data(), 1, Serial.out.size(), stdout);
  return 0;
}
