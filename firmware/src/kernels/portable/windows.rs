//! The windows of a convolution: where the codes of each output pixel lie in the input.

use super::axis::Axis;
use super::codes::block;
use crate::fault::{self, Fault};
use crate::kernels::Conv2dArgs;

/// The input of a convolution as its windows see it.
pub(crate) struct Windows<'a> {
    input: &'a [i8],
    padding_codes: &'a [i8],
    rows: Axis,
    columns: Axis,
    width: usize,
    channels: usize,
    group_channels: usize,
}

impl<'a> Windows<'a> {
    /// `None` where `input` is not of the input shape.
    pub(crate) fn new(args: &Conv2dArgs<'a>, input: &'a [i8]) -> Option<Self> {
        let shape = args.input_shape;
        (shape.elements() == input.len() as u64).then_some(())?;
        Some(Self {
            input,
            padding_codes: args.padding_codes,
            rows: Axis::rows(&args.window, shape),
            columns: Axis::columns(&args.window, shape),
            width: usize::from(shape.width),
            channels: usize::from(shape.channels),
            group_channels: usize::from(shape.channels.checked_div(args.groups)?),
        })
    }

    /// Elements of one window in one group.
    pub(crate) fn depth(&self) -> usize {
        self.rows.kernel() * self.columns.kernel() * self.group_channels
    }

    /// Copies the window of output `(y, x)` in `group` into `row`, in the canonical order of the weights. `widen`
    /// copies the front of a slice of codes to a slice of any element type.
    #[inline]
    pub(crate) fn gather<T: Copy + Default>(
        &self,
        group: usize,
        y: usize,
        x: usize,
        row: &mut [T],
        widen: impl Fn(&[i8], &mut [T]),
    ) {
        let line_len = self.columns.kernel() * self.group_channels;
        if line_len == 0 {
            return;
        }
        // Neighboring taps of all channels lie side by side in the input as they do in the window.
        let solid = if self.channels == self.group_channels { self.columns.solid(x) } else { None };
        for (ky, line) in row.chunks_exact_mut(line_len).enumerate() {
            match (self.rows.tap(y, ky), solid) {
                (Some(iy), Some(ix)) => {
                    let start = (iy * self.width + ix) * self.channels;
                    widen(self.input.get(start..).unwrap_or_default(), line);
                }
                (iy, _) => self.gather_line(group, iy, x, line, &widen),
            }
        }
    }

    /// One line of a window, tap by tap; `iy` is `None` above and below the input.
    fn gather_line<T: Copy + Default>(
        &self,
        group: usize,
        iy: Option<usize>,
        x: usize,
        line: &mut [T],
        widen: impl Fn(&[i8], &mut [T]),
    ) {
        for (kx, tap) in line.chunks_exact_mut(self.group_channels.max(1)).enumerate() {
            let pixel = iy.zip(self.columns.tap(x, kx)).map(|(iy, ix)| iy * self.width + ix);
            let codes = match pixel {
                Some(pixel) => block(self.input, pixel, self.channels),
                None if fault::active(Fault::PaddingZeroPoint) => None,
                None => Some(self.padding_codes),
            };
            match codes.and_then(|codes| block(codes, group, self.group_channels)) {
                Some(codes) => widen(codes, tap),
                None => tap.fill(T::default()),
            }
        }
    }
}
