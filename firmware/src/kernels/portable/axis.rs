//! One axis of a sliding window.

use crate::program::Window;
use crate::tensor::Shape;

/// Where a window reads along one axis of its input.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axis {
    size: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
    dilation: usize,
}

impl Axis {
    /// The vertical axis of `window` over `input`.
    pub(crate) fn rows(window: &Window, input: Shape) -> Self {
        Self {
            size: usize::from(input.height),
            kernel: usize::from(window.kernel_h),
            stride: usize::from(window.stride_h),
            padding: usize::from(window.pad_top),
            dilation: usize::from(window.dilation_h),
        }
    }

    /// The horizontal axis of `window` over `input`.
    pub(crate) fn columns(window: &Window, input: Shape) -> Self {
        Self {
            size: usize::from(input.width),
            kernel: usize::from(window.kernel_w),
            stride: usize::from(window.stride_w),
            padding: usize::from(window.pad_left),
            dilation: usize::from(window.dilation_w),
        }
    }

    /// Taps of the window.
    pub(crate) fn kernel(&self) -> usize {
        self.kernel
    }

    /// Input index that tap `tap` of output `output` reads; `None` in the padding.
    #[inline]
    pub(crate) fn tap(&self, output: usize, tap: usize) -> Option<usize> {
        let padded = output * self.stride + tap * self.dilation;
        padded.checked_sub(self.padding).filter(|at| *at < self.size)
    }

    /// Input indices that output `output` reads, in ascending order.
    #[inline]
    pub(crate) fn taps(self, output: usize) -> impl Iterator<Item = usize> + Clone {
        (0..self.kernel).filter_map(move |tap| self.tap(output, tap))
    }

    /// Whether output `output` reads no padding and its taps are neighbors; if so, the first of them.
    #[inline]
    pub(crate) fn solid(&self, output: usize) -> Option<usize> {
        let first = self.tap(output, 0)?;
        self.tap(output, self.kernel.checked_sub(1)?)?;
        (self.dilation == 1).then_some(first)
    }
}
