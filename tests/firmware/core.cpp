// The protocol core behind standard input and output: one command per line, for the tests.
#include <cstdio>
#include <cstring>

#include "eline.h"

int main() {
  char out[eline::kLongest], name[100], firmware[100];
  char command[8];
  eline::Quadrature quadrature;
  eline::Pace pace(1000, 0);
  while (std::scanf("%7s", command) == 1) {
    if (!std::strcmp(command, "reading")) {
      unsigned seq, t_us, flags;
      int counts;
      if (std::scanf("%u %u %d %u", &seq, &t_us, &counts, &flags) != 4) return 1;
      const eline::Reading reading{static_cast<uint16_t>(seq), t_us, counts,
                                   static_cast<uint8_t>(flags)};
      std::fwrite(out, 1, eline::format_reading(out, reading), stdout);
    } else if (!std::strcmp(command, "banner")) {
      unsigned counts_per_rev, rate_hz;
      if (std::scanf("%99s %99s %u %u", name, firmware, &counts_per_rev, &rate_hz) != 4) return 1;
      const size_t length = eline::format_banner(out, name, firmware, counts_per_rev, rate_hz);
      if (length == 0) std::fputs("refused\n", stdout);
      std::fwrite(out, 1, length, stdout);
    } else if (!std::strcmp(command, "crc")) {
      unsigned byte;
      if (std::scanf("%u", &byte) != 1) return 1;
      const char c = static_cast<char>(byte);
      std::printf("%u\n", eline::crc8(&c, 1));
    } else if (!std::strcmp(command, "ask")) {
      // Bytes in hexadecimal: how many questions are they?
      eline::Requests requests;
      char hex[1024] = "";
      if (std::scanf("%1023s", hex) != 1) return 1;
      int asked = 0;
      for (size_t i = 1; i + 1 < std::strlen(hex); i += 2) {
        unsigned byte;
        std::sscanf(hex + i, "%2x", &byte);
        asked += requests.feed(static_cast<char>(byte));
      }
      std::printf("%d\n", asked);
    } else if (!std::strcmp(command, "begin")) {
      unsigned ab;
      if (std::scanf("%u", &ab) != 1) return 1;
      quadrature = eline::Quadrature(static_cast<uint8_t>(ab));
    } else if (!std::strcmp(command, "step")) {
      unsigned ab;
      if (std::scanf("%u", &ab) != 1) return 1;
      quadrature.step(static_cast<uint8_t>(ab));
      std::printf("%d %d\n", quadrature.counts(), quadrature.illegal());
      quadrature.told();
    } else if (!std::strcmp(command, "pace")) {
      unsigned now;
      if (std::scanf("%u", &now) != 1) return 1;
      pace = eline::Pace(1000, now);
    } else if (!std::strcmp(command, "due")) {
      unsigned now;
      if (std::scanf("%u", &now) != 1) return 1;
      std::printf("%u\n", pace.due(now));
    } else {
      return 1;
    }
  }
  return 0;
}
