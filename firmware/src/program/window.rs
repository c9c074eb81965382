//! The sliding window of convolutions and pools.

use serde::{Deserialize, Serialize};

/// Kernel size, stride, explicit padding and dilation of a sliding window, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Window {
    /// Kernel height.
    pub kernel_h: u8,
    /// Kernel width.
    pub kernel_w: u8,
    /// Vertical stride.
    pub stride_h: u8,
    /// Horizontal stride.
    pub stride_w: u8,
    /// Rows of padding above.
    pub pad_top: u8,
    /// Rows of padding below.
    pub pad_bottom: u8,
    /// Columns of padding on the left.
    pub pad_left: u8,
    /// Columns of padding on the right.
    pub pad_right: u8,
    /// Vertical distance of taps.
    pub dilation_h: u8,
    /// Horizontal distance of taps.
    pub dilation_w: u8,
}

impl Window {
    /// A square kernel with the same stride in both directions and the same padding on all sides, dilation 1.
    pub const fn square(kernel: u8, stride: u8, padding: u8) -> Self {
        Self {
            kernel_h: kernel,
            kernel_w: kernel,
            stride_h: stride,
            stride_w: stride,
            pad_top: padding,
            pad_bottom: padding,
            pad_left: padding,
            pad_right: padding,
            dilation_h: 1,
            dilation_w: 1,
        }
    }

    /// Output height and width over an input of `height × width`, or `None` where the window does not fit or a field
    /// is zero: `out = (in + pads − dilation·(kernel − 1) − 1) / stride + 1`.
    pub fn output_size(&self, height: u16, width: u16) -> Option<(u16, u16)> {
        fn axis(size: u16, before: u8, after: u8, kernel: u8, dilation: u8, stride: u8) -> Option<u16> {
            if kernel == 0 || dilation == 0 || stride == 0 {
                return None;
            }
            let padded = u32::from(size).checked_add(u32::from(before))?.checked_add(u32::from(after))?;
            let steps = padded.checked_sub(reach(kernel, dilation))?.checked_div(u32::from(stride))?;
            u16::try_from(steps.checked_add(1)?).ok()
        }
        let h = axis(height, self.pad_top, self.pad_bottom, self.kernel_h, self.dilation_h, self.stride_h)?;
        let w = axis(width, self.pad_left, self.pad_right, self.kernel_w, self.dilation_w, self.stride_w)?;
        Some((h, w))
    }

    /// Whether all padding is smaller than the kernel's reach, so that no window lies in padding alone.
    pub fn padding_is_inside(&self) -> bool {
        let vertical = reach(self.kernel_h, self.dilation_h);
        let horizontal = reach(self.kernel_w, self.dilation_w);
        u32::from(self.pad_top.max(self.pad_bottom)) < vertical
            && u32::from(self.pad_left.max(self.pad_right)) < horizontal
    }
}

/// Pixels from the first to the last tap of a kernel, both included.
fn reach(kernel: u8, dilation: u8) -> u32 {
    u32::from(dilation).saturating_mul(u32::from(kernel).saturating_sub(1)).saturating_add(1)
}
