//! A border into the window of the convolution or maximum that reads it.

use super::rewrite::merge_into_reader;
use crate::ir::{Conv2d, Graph, Op, Pad};
use firmware::program::Window;

/// A convolution pads with zeros; a maximum never takes its padding, which equals a border of −∞. The window's padding
/// stays smaller than its kernel, as the engine demands; a wider border stays an operator.
pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, operand| {
        let Op::Pad(pad) = &producer.op else { return None };
        if operand != 0 {
            return None;
        }
        let op = match &reader.op {
            Op::Conv2d(conv) if pad.value == 0.0 && conv.normalization.is_none() => {
                Op::Conv2d(Conv2d { window: widened(&conv.window, pad)?, ..conv.clone() })
            }
            Op::MaxPool(window) if pad.value == f32::NEG_INFINITY => Op::MaxPool(widened(window, pad)?),
            _ => return None,
        };
        let mut inputs = reader.inputs.clone();
        inputs[0] = producer.inputs[0];
        Some((op, inputs))
    });
}

/// The window with the border as padding.
fn widened(window: &Window, pad: &Pad) -> Option<Window> {
    if pad.before[2] != 0 || pad.after[2] != 0 {
        return None;
    }
    let add = |own: u8, border: u16| u8::try_from(u32::from(own) + u32::from(border)).ok();
    let window = Window {
        pad_top: add(window.pad_top, pad.before[0])?,
        pad_left: add(window.pad_left, pad.before[1])?,
        pad_bottom: add(window.pad_bottom, pad.after[0])?,
        pad_right: add(window.pad_right, pad.after[1])?,
        ..*window
    };
    window.padding_is_inside().then_some(window)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::ir::{Clip, Weights};
    use crate::passes::fixture::image;
    use crate::reference;
    use std::sync::Arc;

    /// The graph `pad → op`, and its outputs before and after the pass.
    fn folded(pad: Pad, op: Op) -> (Graph, [Vec<Vec<f32>>; 2]) {
        let (mut graph, rgb) = image();
        let x = graph.push("pad", Op::Pad(pad), &[rgb]).unwrap();
        let y = graph.push("y", op, &[x]).unwrap();
        graph.outputs.push(y);
        let input = vec![(0..48).map(|v| v as f32 - 60.0).collect()];
        let before = reference::run(&graph, &input, |_, _| ()).unwrap();
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        let after = reference::run(&graph, &input, |_, _| ()).unwrap();
        (graph, [before, after])
    }

    fn conv(window: Window) -> Op {
        let data = (0..3 * 3 * 3 * 2).map(|v| v as f32 - 20.0).collect();
        let weights = Arc::new(Weights { shape: vec![2, 3, 3, 3], data });
        Op::Conv2d(Conv2d { weights, bias: None, window, groups: 1, normalization: None, clip: Clip::NONE })
    }

    #[test]
    fn border_of_the_right_value_becomes_padding() {
        let pad = Pad { before: [1, 2, 0], after: [0, 1, 0], value: 0.0 };
        let (graph, [before, after]) = folded(pad, conv(Window::square(3, 2, 0)));
        assert_eq!((graph.nodes.len(), &before), (2, &after));
        let (graph, [before, after]) =
            folded(Pad { value: f32::NEG_INFINITY, ..pad }, Op::MaxPool(Window::square(3, 1, 0)));
        assert_eq!((graph.nodes.len(), &before), (2, &after));
    }

    #[test]
    fn another_value_another_axis_or_too_wide_a_border_stays() {
        let pad = Pad { before: [1, 1, 0], after: [1, 1, 0], value: 0.0 };
        for (pad, op) in [
            (Pad { value: 1.0, ..pad }, conv(Window::square(3, 1, 0))),
            (pad, Op::MaxPool(Window::square(3, 1, 0))),
            (Pad { before: [0, 0, 1], after: [0; 3], value: f32::MIN }, Op::MaxPool(Window::square(3, 1, 0))),
            (Pad { before: [2, 0, 0], ..pad }, conv(Window::square(3, 1, 1))),
            (pad, Op::AveragePool(Window::square(3, 1, 0))),
        ] {
            assert_eq!(folded(pad, op).0.nodes.len(), 3);
        }
    }
}
