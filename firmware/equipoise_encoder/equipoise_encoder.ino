// An incremental encoder and a button, sent to the host as E-lines, 1000 per second.
//
// For Arduino (Uno R4, Leonardo, Nano Every, ...), Raspberry Pi Pico (core of Earle Philhower) and
// Teensy 3/4. Wiring, boards and checks: firmware/README.md. What is sent: docs/reference/e-line.md.

#include "eline.h"

// ---- What may have to be changed.

constexpr uint32_t COUNTS_PER_REV = 8192;  // lines of the encoder x 4
constexpr uint8_t PIN_A = 2;               // both can interrupt on every board named above
constexpr uint8_t PIN_B = 3;
constexpr uint8_t PIN_BUTTON = 4;  // to ground, closed when pressed
constexpr uint32_t RATE_HZ = 1000;
constexpr uint32_t BAUD = 500000;  // of a real serial line; native USB ignores it

// ---- From here on nothing has to be changed.

constexpr char NAME[] = "equipoise-encoder";
constexpr char FIRMWARE[] = "1.0";
constexpr uint32_t BOUNCE_US = 5000;  // a button that has just changed may bounce

eline::Quadrature quadrature;
eline::Requests requests;
eline::Pace pace(1000000UL / RATE_HZ, 0);
uint16_t seq = 0;
bool down = false;
bool pressed = false;  // since the last line that was sent
uint32_t button_us = 0;
char line[eline::kLongest];

uint8_t read_lines() {
  return static_cast<uint8_t>(digitalRead(PIN_A) << 1 | digitalRead(PIN_B));
}

void on_edge() { quadrature.step(read_lines()); }

// A line that finds no room is lost whole: the host sees it missing, and nothing ever waits.
bool send(size_t length) {
  if (static_cast<size_t>(Serial.availableForWrite()) < length) return false;
  Serial.write(reinterpret_cast<const uint8_t *>(line), length);
  return true;
}

void introduce() {
  send(eline::format_banner(line, NAME, FIRMWARE, COUNTS_PER_REV, RATE_HZ));
}

void watch_button(uint32_t now_us) {
  const bool is_down = digitalRead(PIN_BUTTON) == LOW;
  if (is_down == down || now_us - button_us < BOUNCE_US) return;
  button_us = now_us;
  down = is_down;
  pressed = pressed || is_down;
}

void setup() {
  pinMode(PIN_A, INPUT_PULLUP);
  pinMode(PIN_B, INPUT_PULLUP);
  pinMode(PIN_BUTTON, INPUT_PULLUP);
  Serial.begin(BAUD);
  quadrature = eline::Quadrature(read_lines());
  attachInterrupt(digitalPinToInterrupt(PIN_A), on_edge, CHANGE);
  attachInterrupt(digitalPinToInterrupt(PIN_B), on_edge, CHANGE);
  introduce();
  pace = eline::Pace(1000000UL / RATE_HZ, micros());
}

void loop() {
  while (Serial.available() > 0) {
    if (requests.feed(static_cast<char>(Serial.read()))) introduce();
  }
  const uint16_t periods = pace.due(micros());
  if (periods == 0) return;
  seq = static_cast<uint16_t>(seq + periods - 1);

  noInterrupts();  // count, time and flag of one moment
  const uint32_t now_us = micros();
  const int32_t counts = quadrature.counts();
  const bool illegal = quadrature.illegal();
  if (illegal) quadrature.told();
  interrupts();

  watch_button(now_us);
  uint8_t flags = 0;
  if (down) flags |= eline::kDown;
  if (pressed) flags |= eline::kPressed;
  static bool illegal_untold = false;
  illegal_untold = illegal_untold || illegal;
  if (illegal_untold) flags |= eline::kIllegal;

  if (send(eline::format_reading(line, {seq, now_us, counts, flags}))) {
    pressed = false;
    illegal_untold = false;
  }
  seq = static_cast<uint16_t>(seq + 1);
}
