//! `Slice` of a map, a vector or a constant.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::{Op, Slice};

/// A range of one axis: from `begin` by `step` up (or down) to `end`, exclusive; `end` is −1 where it runs down to the
/// first element.
struct Range {
    axis: usize,
    begin: i64,
    end: i64,
    step: i64,
}

impl Range {
    fn indices(&self) -> Vec<usize> {
        let at = |i: i64| self.begin.checked_add(i.checked_mul(self.step)?);
        let inside = |&at: &i64| if self.step > 0 { at < self.end } else { at > self.end };
        (0..).map_while(|i| at(i).filter(inside)).map(|at| at as usize).collect()
    }
}

pub(super) fn slice(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let ranges = ranges(t, node, x.dims())?;
    match x {
        Value::Constant(mut tensor) => {
            for range in ranges {
                tensor = tensor.select(range.axis, &range.indices());
                t.charge(tensor.len())?;
            }
            Ok(Value::Constant(tensor))
        }
        Value::Activation(x) => activation(t, node, x, &ranges),
    }
}

/// `starts`, `ends`, `axes` are attributes to operator set 9, then operands, with `steps`.
fn ranges(t: &mut Translator<'_>, node: &Node<'_>, dims: &[usize]) -> Result<Vec<Range>> {
    let mut list = |name: &str, index: usize| {
        if node.opset < 10 { Ok(node.ints(name)?.map(<[i64]>::to_vec)) } else { t.integers(node, index) }
    };
    let starts = list("starts", 1)?.ok_or_else(|| node.malformed("found no starts"))?;
    let ends = list("ends", 2)?.ok_or_else(|| node.malformed("found no ends"))?;
    let axes = list("axes", 3)?.unwrap_or_else(|| (0..starts.len() as i64).collect());
    let steps = list("steps", 4)?.unwrap_or_else(|| vec![1; starts.len()]);
    if [ends.len(), axes.len(), steps.len()].iter().any(|&length| length != starts.len()) {
        return Err(node.malformed("starts, ends, axes and steps differ in length"));
    }
    let mut ranges: Vec<Range> = Vec::new();
    for (i, &axis) in axes.iter().enumerate() {
        let axis = node.axis(axis, dims.len())?;
        let size = dims[axis] as i64;
        let step = steps[i];
        if step == 0 {
            return Err(node.malformed("found step 0"));
        }
        // From the end where negative, then inside; ends beyond every size are usual.
        let inside = |index: i64, least: i64, most: i64| {
            let index = if index < 0 { index.saturating_add(size) } else { index };
            index.clamp(least, most.max(least))
        };
        let (begin, end) = if step > 0 {
            (inside(starts[i], 0, size), inside(ends[i], 0, size))
        } else {
            (inside(starts[i], -1, size - 1), inside(ends[i], -1, size - 1))
        };
        if ranges.iter().any(|range| range.axis == axis) {
            return Err(node.malformed(format!("slices axis {axis} twice")));
        }
        ranges.push(Range { axis, begin, end, step });
    }
    Ok(ranges)
}

fn activation(t: &mut Translator<'_>, node: &Node<'_>, x: Activation, ranges: &[Range]) -> Result<Value> {
    let Some(map_axes) = x.map_axes() else {
        return Err(node.unsupported(format!("slices {}, expected a map or a vector", x.described())));
    };
    let all = Slice { begin: [0; 3], end: [x.shape.height, x.shape.width, x.shape.channels], stride: [1; 3] };
    let mut slice = all;
    for range in ranges {
        if range.step < 0 {
            return Err(node.unsupported(format!("step {}, expected at least 1", range.step)));
        }
        if range.begin >= range.end {
            return Err(node.malformed(format!("leaves nothing of axis {} of {}", range.axis, x.described())));
        }
        if let Some(axis) = map_axes[range.axis] {
            // Within the size of the axis; a longer stride takes the same single element.
            slice.begin[axis] = range.begin as u16;
            slice.end[axis] = range.end as u16;
            slice.stride[axis] = u16::try_from(range.step).unwrap_or(u16::MAX);
        }
    }
    if slice == all {
        return Ok(Value::Activation(x));
    }
    let sliced = if x.is_map() { Activation::map } else { Activation::vector };
    let (id, shape) = t.push(node, Op::Slice(slice), &[x.id])?;
    Ok(Value::Activation(sliced(id, shape)))
}
