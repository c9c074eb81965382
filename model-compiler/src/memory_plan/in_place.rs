//! Which operands an operator may overwrite with its output.

use crate::qmodel::{QModel, QOp, QRescale, QResidual, QTensorId};
use firmware::kernels::plan::max_pool_in_place;

/// Operands whose memory the output may take over, if nothing else needs them; a max pool's only if `pooling`, the
/// others only if `sums`.
///
/// The kernels read such an operand element by element (attention, softmax: row by row; max pool: where the rule of
/// the kernels holds) before they write there. An operand that the step reads twice is excluded.
pub(super) fn overwritable(model: &QModel, op: &QOp, pooling: bool, sums: bool) -> Vec<QTensorId> {
    let output = model.tensor(op.output());
    let residual = |rescale: &QRescale| match rescale.residual {
        QResidual::None => vec![],
        QResidual::Scaled { tensor, .. } | QResidual::Stream { tensor } => vec![tensor],
    };
    let candidates = match op {
        QOp::MaxPool { input, window, .. } if pooling => {
            let input_shape = model.tensor(*input).shape;
            let allowed = max_pool_in_place(input_shape, output.shape, *window);
            let same_type = model.tensor(*input).element == output.element;
            return if allowed && same_type { vec![*input] } else { vec![] };
        }
        QOp::Conv2d { rescale, .. } | QOp::Linear { rescale, .. } if sums => residual(rescale),
        QOp::Add { first, second, .. } if sums => vec![first.tensor, second.tensor],
        QOp::ResizeBilinear { residual: Some(residual), .. } if sums => vec![residual.tensor],
        QOp::Attention { query, .. } if sums => vec![*query],
        QOp::Softmax { input, .. } | QOp::Sigmoid { input, .. } if sums => vec![*input],
        _ => vec![],
    };
    let reads = op.reads();
    candidates
        .into_iter()
        .filter(|&t| {
            let operand = model.tensor(t);
            let once = reads.iter().filter(|&&r| r == t).count() == 1;
            once && operand.element == output.element && operand.shape == output.shape
        })
        .collect()
}
