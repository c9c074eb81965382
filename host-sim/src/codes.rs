//! From stored bytes to integer codes and real values, and what a code's bounds are.

use firmware::program::Clamp;
use firmware::tensor::ElementType;
use model_compiler::qmodel::{QOp, QStep, QTensor};

/// The integers behind little-endian element bytes. Scratch bytes count as unsigned.
pub fn decode(bytes: &[u8], element: ElementType) -> Vec<i32> {
    match element {
        ElementType::I8 => bytes.iter().map(|&b| i32::from(b.cast_signed())).collect(),
        ElementType::I16 => bytes.as_chunks::<2>().0.iter().map(|&b| i32::from(i16::from_le_bytes(b))).collect(),
        ElementType::I32 => bytes.as_chunks::<4>().0.iter().map(|&b| i32::from_le_bytes(b)).collect(),
        ElementType::Scratch => bytes.iter().map(|&b| i32::from(b)).collect(),
    }
}

/// Name of an element type in reports.
pub fn element_name(element: ElementType) -> &'static str {
    match element {
        ElementType::I8 => "i8",
        ElementType::I16 => "i16",
        ElementType::I32 => "i32",
        ElementType::Scratch => "scratch",
    }
}

/// `scale · (code − zero_point)` of every code of a tensor.
pub fn dequantize(tensor: &QTensor, codes: &[i32]) -> Vec<f32> {
    let real = |&code: &i32| (tensor.scale * (f64::from(code) - f64::from(tensor.zero_point))) as f32;
    codes.iter().map(real).collect()
}

/// Lowest and highest real value that an operator can write to its output: clamp bounds, or the range of the type.
pub fn clip_range(tensor: &QTensor, op: &QOp) -> [f64; 2] {
    let (low, high) = match tensor.element {
        ElementType::I8 => (i32::from(i8::MIN), i32::from(i8::MAX)),
        ElementType::I16 => (i32::from(i16::MIN), i32::from(i16::MAX)),
        ElementType::I32 => (i32::MIN, i32::MAX),
        ElementType::Scratch => (0, i32::from(u8::MAX)),
    };
    let (low, high) = output_clamp(op).map_or((low, high), |(c, _)| (low.max(c.min.into()), high.min(c.max.into())));
    [low, high].map(|code| tensor.scale * (f64::from(code) - f64::from(tensor.zero_point)))
}

/// Clamp and zero point of an operator's output; `None` for copies, probabilities, points and waypoints.
fn output_clamp(op: &QOp) -> Option<(Clamp, i16)> {
    match op {
        QOp::Conv2d { rescale, .. } | QOp::Linear { rescale, .. } | QOp::BranchLinear { rescale, .. } => {
            Some((rescale.clamp, rescale.zero_point))
        }
        QOp::AveragePool { clamp, zero_point, .. }
        | QOp::GlobalPool { clamp, zero_point, .. }
        | QOp::Add { clamp, zero_point, .. }
        | QOp::Requantize { clamp, zero_point, .. }
        | QOp::ResizeBilinear { clamp, zero_point, .. }
        | QOp::Tokens { clamp, zero_point, .. }
        | QOp::LayerNorm { clamp, zero_point, .. }
        | QOp::Attention { clamp, zero_point, .. }
        | QOp::Concat { clamp, zero_point, .. }
        | QOp::GatherSum { clamp, zero_point, .. } => Some((*clamp, *zero_point)),
        QOp::MaxPool { .. }
        | QOp::CopyBox { .. }
        | QOp::Softmax { .. }
        | QOp::Sigmoid { .. }
        | QOp::SpatialSoftmax { .. }
        | QOp::WaypointDecoder(_) => None,
    }
}

/// The output bounds at which codes saturate; `None` for bounds of the network itself (ReLU, clip), which are no loss,
/// and for a lower bound equal to the zero point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SaturationBounds {
    min: Option<i16>,
    max: Option<i16>,
}

impl SaturationBounds {
    /// The bounds of a step; `None` where its output cannot saturate (copies, probabilities, points, waypoints).
    pub fn of(step: &QStep) -> Option<Self> {
        let (clamp, zero_point) = output_clamp(&step.op)?;
        let Clamp { min, max } = clamp;
        let [low, high] = step.bounds.clipped;
        Some(Self { min: (min != zero_point && !low).then_some(min), max: (!high).then_some(max) })
    }

    /// How many codes lie at a bound.
    pub fn count(&self, codes: &[i32]) -> u64 {
        let bounds = [self.min, self.max];
        let at_bound = |&&code: &&i32| bounds.into_iter().flatten().any(|bound| code == i32::from(bound));
        codes.iter().filter(at_bound).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::program::Requant;
    use firmware::tensor::Shape;
    use model_compiler::qmodel::{Bounds, QTensorId};

    #[test]
    fn elements_are_little_endian_and_signed() {
        assert_eq!(decode(&[0x80, 0xff, 1], ElementType::I8), [-128, -1, 1]);
        assert_eq!(decode(&[0xfe, 0xff, 2, 1], ElementType::I16), [-2, 258]);
        assert_eq!(decode(&[0, 0, 0xff, 0xff], ElementType::I32), [-65536]);
    }

    #[test]
    fn real_values_follow_scale_and_zero_point() {
        let tensor = QTensor {
            name: "t".into(),
            value: "t".into(),
            shape: Shape::vector(2),
            element: ElementType::I8,
            scale: 0.5,
            zero_point: -128,
            saturation_ppm: None,
        };
        assert_eq!(dequantize(&tensor, &[-128, 127]), [0.0, 127.5]);
    }

    #[test]
    fn the_clip_range_is_that_of_the_clamp_or_of_the_type() {
        let mut tensor = QTensor {
            name: "t".into(),
            value: "t".into(),
            shape: Shape::vector(2),
            element: ElementType::I8,
            scale: 0.5,
            zero_point: -128,
            saturation_ppm: None,
        };
        let pool = QOp::MaxPool {
            input: QTensorId(0),
            output: QTensorId(1),
            window: firmware::program::Window::square(2, 2, 0),
        };
        assert_eq!(clip_range(&tensor, &pool), [0.0, 127.5]);
        let relu = QOp::Requantize {
            input: QTensorId(0),
            output: QTensorId(1),
            input_zero_point: 0,
            requant: Requant { multiplier: 1 << 23, shift: 23 },
            zero_point: 0,
            clamp: Clamp { min: 0, max: 127 },
        };
        tensor.zero_point = 0;
        assert_eq!(clip_range(&tensor, &relu), [0.0, 63.5]);
    }

    #[test]
    fn bounds_of_the_network_are_not_saturation() {
        let step = |zero_point, min, clipped| QStep {
            name: "step".into(),
            node: None,
            op: QOp::Requantize {
                input: QTensorId(0),
                output: QTensorId(1),
                input_zero_point: 0,
                requant: Requant { multiplier: 1 << 23, shift: 23 },
                zero_point,
                clamp: Clamp { min, max: 127 },
            },
            bounds: Bounds { clipped, ..Bounds::default() },
        };
        let saturated = |step: &QStep| SaturationBounds::of(step).unwrap().count(&[-128, -128, 0, 5, 127]);
        assert_eq!(saturated(&step(-128, -128, [false; 2])), 1);
        assert_eq!(saturated(&step(0, -128, [false; 2])), 3);
        assert_eq!(saturated(&step(5, 5, [false; 2])), 1);
        assert_eq!(saturated(&step(0, -128, [true, false])), 1);
        assert_eq!(saturated(&step(0, -128, [false, true])), 2);
        assert_eq!(saturated(&step(0, -128, [true; 2])), 0);
    }
}
