// What the image loss works on.
#pragma once
#include <cstdint>

namespace image_loss {

constexpr int64_t REACH = 5;  // of the window: 11 taps

struct Job {
    const float *rendered, *target;  // (images, height, width, channels)
    const float *mask;               // (images, height, width) or null
    float *gradient;                 // by rendered, or null where none is wanted
    int64_t images, height, width, channels;
    float l1_scale, ssim_scale;  // what a unit of weighted |d| and of weighted 1 - SSIM adds to the loss
};

}  // namespace image_loss
