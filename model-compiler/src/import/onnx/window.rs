//! Sliding windows: ONNX's attributes to kernel, stride, explicit padding and dilation.

use super::node::Node;
use crate::error::Result;
use crate::ir::Shape;
use firmware::program::Window;

/// Padding in rows and columns: top, left, bottom, right.
pub(super) type Pads = [u16; 4];

/// A window whose padding may exceed what a [`Window`] holds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sliding {
    /// Without padding.
    pub(super) window: Window,
    pub(super) pads: Pads,
    /// Whether the last window reaches beyond the padding (`ceil_mode`).
    pub(super) overhangs: bool,
}

impl Sliding {
    /// Whether there is any padding.
    pub(super) fn is_padded(&self) -> bool {
        self.pads != [0; 4]
    }

    /// The window with its padding, unless there is more of it than a window may have: less than the kernel's reach.
    pub(super) fn with_padding(&self) -> Option<Window> {
        let [top, left, bottom, right] = self.pads.map(|pad| u8::try_from(pad).ok());
        let window = Window { pad_top: top?, pad_left: left?, pad_bottom: bottom?, pad_right: right?, ..self.window };
        window.padding_is_inside().then_some(window)
    }
}

/// Reads `strides`, `dilations`, `pads`, `auto_pad` and `ceil_mode`.
///
/// # Errors
/// An attribute is of the wrong length or out of range, or the window does not fit the map.
pub(super) fn sliding(node: &Node<'_>, kernel: [usize; 2], shape: Shape) -> Result<Sliding> {
    let kernel = kernel.map(|size| size as i64);
    let strides = pair(node, "strides")?.unwrap_or([1; 2]);
    let dilations = pair(node, "dilations")?.unwrap_or([1; 2]);
    let byte = |what: &str, value: i64| {
        u8::try_from(value)
            .ok()
            .filter(|&v| v > 0)
            .ok_or_else(|| node.unsupported(format!("{what} {value}, expected 1 to 255")))
    };
    let window = Window {
        kernel_h: byte("kernel height", kernel[0])?,
        kernel_w: byte("kernel width", kernel[1])?,
        stride_h: byte("stride", strides[0])?,
        stride_w: byte("stride", strides[1])?,
        dilation_h: byte("dilation", dilations[0])?,
        dilation_w: byte("dilation", dilations[1])?,
        ..Window::square(1, 1, 0)
    };
    let auto_pad = node.text("auto_pad", "NOTSET")?;
    let given = given_pads(node)?;
    let ceil = node.int("ceil_mode", 0)? != 0;
    let mut sliding = Sliding { window, pads: [0; 4], overhangs: false };
    for (axis, size) in [shape.height, shape.width].into_iter().map(i64::from).enumerate() {
        let reach = (kernel[axis] - 1) * dilations[axis] + 1;
        let stride = strides[axis];
        let [before, after] = match auto_pad.as_str() {
            "NOTSET" | "" => [given[axis], given[axis + 2]],
            "VALID" => [0, 0],
            "SAME_UPPER" | "SAME_LOWER" => {
                let total = (((size + stride - 1) / stride - 1) * stride + reach - size).max(0);
                let [less, more] = [total / 2, total - total / 2];
                if auto_pad == "SAME_UPPER" { [less, more] } else { [more, less] }
            }
            other => return Err(node.unsupported(format!("auto_pad {other:?}"))),
        };
        let free = size + before + after - reach;
        if free < 0 {
            let padded = size + before + after;
            return Err(node.malformed(format!("a window that reaches over {reach} does not fit {padded} pixels")));
        }
        let overhang = if ceil { overhang(free, stride, reach, after) } else { 0 };
        sliding.overhangs |= overhang > 0;
        let narrow = |pad: i64| {
            u16::try_from(pad).map_err(|_| node.unsupported(format!("padding {pad}, expected at most 65535")))
        };
        sliding.pads[axis] = narrow(before)?;
        sliding.pads[axis + 2] = narrow(after + overhang)?;
    }
    Ok(sliding)
}

/// Pixels beyond the padding that one more window needs where the stride leaves a remainder of `free`. That window
/// counts only where it begins before the padding behind the map.
fn overhang(free: i64, stride: i64, reach: i64, after: i64) -> i64 {
    let remainder = free % stride;
    let begins_at_end_of_map = free - remainder + stride >= free + reach - after;
    if remainder == 0 || begins_at_end_of_map { 0 } else { stride - remainder }
}

/// `pads`: top, left, bottom, right.
fn given_pads(node: &Node<'_>) -> Result<[i64; 4]> {
    let Some(pads) = node.ints("pads")? else { return Ok([0; 4]) };
    let known = <[i64; 4]>::try_from(pads).ok().filter(|pads| pads.iter().all(|p| (0..=65535).contains(p)));
    known.ok_or_else(|| node.malformed(format!("pads: found {pads:?}, expected four numbers from 0 to 65535")))
}

/// Two positive numbers: vertical, horizontal.
pub(super) fn pair(node: &Node<'_>, name: &str) -> Result<Option<[i64; 2]>> {
    let Some(found) = node.ints(name)? else { return Ok(None) };
    match <[i64; 2]>::try_from(found).ok().filter(|pair| pair.iter().all(|v| (1..=65535).contains(v))) {
        Some(pair) => Ok(Some(pair)),
        None => Err(node.malformed(format!("{name}: found {found:?}, expected two positive numbers (2-d)"))),
    }
}
