//! Every check of `Image::parse`: one change of the sample image that it, and no earlier check, refuses.

#[path = "support/sample_image.rs"]
mod sample_image;

use firmware::fault::disable_check;
use firmware::image::layout::{header, region, section, tensor};
use firmware::image::{Check, Image, ParseError, Region, RegionName, SectionKind, TensorRecord, layout};
use firmware::kernels::plan;
use firmware::program::*;
use firmware::tensor::{ElementType, Shape, TensorId};
use model_compiler::emit::{AlignedBytes, ImageParts, ImagePort, assemble, reseal};
use sample_image::{STEPS, at, ids};

/// A change of the sample: of its parts, of its bytes (then sealed again), or of its bytes alone.
enum Change {
    Parts(fn(&mut ImageParts)),
    Sealed(fn(&mut Vec<u8>)),
    Raw(fn(&mut Vec<u8>)),
}

use Change::{Parts, Raw, Sealed};

/// Edits the step at a position.
macro_rules! step {
    ($parts:ident, $at:expr, $kind:ident, |$step:ident| $edit:expr) => {
        match &mut $parts.steps[$at] {
            Step::$kind($step) => $edit,
            _ => unreachable!("the sample has a {} there", stringify!($kind)),
        }
    };
}

fn record(parts: &mut ImageParts, id: u16) -> &mut TensorRecord {
    &mut parts.tensors[usize::from(id)]
}

/// Moves tensors to memory of their own, all to the same place.
fn to_fresh_memory(parts: &mut ImageParts, tensors: &[u16]) {
    for id in tensors {
        record(parts, *id).offset = parts.regions[0].bytes;
    }
    parts.regions[0].bytes += 8192;
}

/// A second region.
fn fast() -> Region {
    Region { name: RegionName::new("fast").expect("a name"), bytes: 64, alignment: 16 }
}

fn slot(kind: SectionKind) -> usize {
    header::SECTIONS.start + kind as usize * section::BYTES
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes")) as usize
}

fn put_u32(bytes: &mut [u8], at: usize, value: usize) {
    bytes[at..at + 4].copy_from_slice(&(value as u32).to_le_bytes());
}

/// First byte of a section.
fn start(bytes: &[u8], kind: SectionKind) -> usize {
    u32_at(bytes, slot(kind) + section::OFFSET.start)
}

/// First byte behind a section, its padding not counted.
fn end(bytes: &[u8], kind: SectionKind) -> usize {
    start(bytes, kind) + u32_at(bytes, slot(kind) + section::LENGTH.start)
}

fn scratch_record(parts: &mut ImageParts) -> &mut TensorRecord {
    parts.tensors.iter_mut().find(|t| t.element == ElementType::Scratch).expect("the sample has scratch")
}

fn port(name: &str, id: u16) -> ImagePort {
    ImagePort { name: name.into(), tensor: TensorId(id), scale: 1.0, zero_point: 0 }
}

fn header_changes() -> Vec<(Check, Change)> {
    vec![
        (Check::HeaderLength, Raw(|b| b.truncate(header::BYTES - 1))),
        (Check::Magic, Raw(|b| b[0] ^= 1)),
        (Check::Magic, Raw(|b| b[7] ^= 1)),
        (Check::Format, Sealed(|b| b[header::FORMAT.start] = 2)),
        (Check::Format, Sealed(|b| b[header::FORMAT.start] = 0)),
        (Check::HeaderCrc, Raw(|b| b[header::NAME.start] ^= 1)),
        (Check::TotalBytes, Raw(|b| b.extend([0; 16]))),
        (Check::HeaderReserved, Sealed(|b| b[header::RESERVED_A.start] = 1)),
        (Check::HeaderReserved, Sealed(|b| b[header::RESERVED_B.start] = 1)),
        (Check::HeaderReserved, Sealed(|b| b[header::RESERVED_B.end - 1] = 1)),
        (Check::HeaderReserved, Sealed(|b| b[header::REGIONS.end - 1] = 1)),
        (Check::HeaderReserved, Sealed(|b| b[header::SECTIONS.end - 1] = 1)),
        (Check::Features, Sealed(|b| b[header::FEATURES.start + 2] |= 8)),
        (Check::Features, Sealed(|b| b[header::FEATURES.start + 4] |= 4)),
        (Check::Features, Sealed(|b| b[header::FEATURES.end - 1] |= 0x80)),
        (Check::StepCount, Sealed(|b| b[header::STEP_COUNT].fill(0))),
        (Check::StepCount, Sealed(|b| b[header::STEP_COUNT].copy_from_slice(&2049_u16.to_le_bytes()))),
        (Check::TensorCount, Sealed(|b| b[header::TENSOR_COUNT].fill(0))),
        (Check::TensorCount, Sealed(|b| b[header::TENSOR_COUNT].fill(0xFF))),
        (Check::InputCount, Sealed(|b| b[header::INPUT_COUNT].fill(0))),
        (Check::InputCount, Sealed(|b| b[header::INPUT_COUNT].fill(17))),
        (Check::OutputCount, Sealed(|b| b[header::OUTPUT_COUNT].fill(0))),
        (Check::OutputCount, Sealed(|b| b[header::OUTPUT_COUNT].fill(17))),
        (Check::RegionCount, Sealed(|b| b[header::REGION_COUNT].fill(0))),
        (Check::RegionCount, Sealed(|b| b[header::REGION_COUNT].fill(5))),
        (Check::RegionName, Sealed(|b| b[header::REGION_COUNT].fill(2))),
        (Check::RegionName, Sealed(|b| b[header::REGIONS.start] = 0)),
        (Check::RegionName, Sealed(|b| b[header::REGIONS.start + 1] = b' ')),
        (Check::RegionName, Sealed(|b| b[header::REGIONS.start + region::NAME.end - 1] = b'x')),
        (Check::RegionRepeated, Parts(|p| p.regions.push(p.regions[0]))),
        (Check::RegionBytes, Parts(|p| p.regions.push(Region { bytes: u32::MAX, ..fast() }))),
        (Check::RegionAlignment, Parts(|p| p.regions.push(Region { alignment: 0, ..fast() }))),
        (Check::RegionAlignment, Parts(|p| p.regions[0].alignment = 8)),
        (Check::RegionAlignment, Parts(|p| p.regions[0].alignment = 48)),
        (Check::RegionAlignment, Parts(|p| p.regions[0].alignment = 8192)),
        (Check::ModelName, Sealed(|b| b[header::NAME.start] = 0xFF)),
        (Check::ModelName, Sealed(|b| b[header::NAME.end - 1] = b'x')),
        (Check::TargetName, Sealed(|b| b[header::TARGET.start] = 0xFF)),
        (Check::TargetName, Sealed(|b| b[header::TARGET.start] = b' ')),
        (Check::TargetName, Sealed(|b| b[header::TARGET.start] = 0)),
        (Check::TargetName, Sealed(|b| b[header::TARGET.end - 1] = b'x')),
    ]
}

fn section_changes() -> Vec<(Check, Change)> {
    vec![
        (Check::SectionKind, Sealed(|b| b[slot(SectionKind::Tensors)] ^= 1)),
        (Check::SectionOffset, Sealed(|b| b[slot(SectionKind::Program) + section::OFFSET.start] ^= 16)),
        (Check::SectionLength, Sealed(|b| b[slot(SectionKind::Ports) + section::LENGTH.start] ^= 32)),
        (Check::SectionLength, Sealed(|b| b[slot(SectionKind::Tensors) + section::LENGTH.start] ^= 32)),
        (Check::SectionLength, Sealed(|b| b[slot(SectionKind::StepIndex) + section::LENGTH.start] ^= 4)),
        (Check::SectionLength, Sealed(|b| b[slot(SectionKind::KnownAnswer) + section::LENGTH.start] ^= 4)),
        (Check::SectionEnd, Sealed(|b| b[slot(SectionKind::Constants) + section::LENGTH.start + 3] = 1)),
        (Check::SectionEnd, Sealed(|b| put_u32(b, slot(SectionKind::KnownAnswer) + section::LENGTH.start, 0))),
        (
            Check::SectionPadding,
            Sealed(|b| {
                let ends = [SectionKind::StepIndex, SectionKind::Program].map(|kind| end(b, kind));
                let padding = ends.into_iter().find(|end| !end.is_multiple_of(16)).expect("a section with padding");
                b[padding] = 1;
            }),
        ),
        (
            Check::SectionCrc,
            Raw(|b| {
                let tensors = start(b, SectionKind::Tensors);
                b[tensors + tensor::OFFSET.start] ^= 16;
            }),
        ),
        (
            Check::StepIndex,
            Sealed(|b| {
                let index = start(b, SectionKind::StepIndex);
                b[index] = 1;
            }),
        ),
        (
            Check::StepIndex,
            Sealed(|b| {
                let index = start(b, SectionKind::StepIndex);
                b.copy_within(index + 4..index + 8, index + 8);
            }),
        ),
        (
            Check::StepIndex,
            Sealed(|b| {
                let index = start(b, SectionKind::StepIndex);
                put_u32(b, index + 4 * (STEPS - 1), 1 << 20);
            }),
        ),
        (
            Check::StepDecode,
            Sealed(|b| {
                let program = start(b, SectionKind::Program);
                b[program] = 200;
            }),
        ),
        (
            Check::StepLength,
            Sealed(|b| {
                let index = start(b, SectionKind::StepIndex);
                let second = u32_at(b, index + 4);
                put_u32(b, index + 4, second + 1);
            }),
        ),
        (Check::StepFeatures, Sealed(|b| b[header::FEATURES.start + 1] &= !8)),
        (Check::StepFeatures, Sealed(|b| b[header::FEATURES.start + 4] |= 2)),
    ]
}

/// Sets a byte of the first tensor record.
fn first_record(bytes: &mut [u8], field: usize, value: u8) {
    let tensors = start(bytes, SectionKind::Tensors);
    bytes[tensors + field] = value;
}

fn table_changes() -> Vec<(Check, Change)> {
    vec![
        (Check::TensorElement, Sealed(|b| first_record(b, tensor::ELEMENT.start, 4))),
        (Check::TensorReserved, Sealed(|b| first_record(b, tensor::RESERVED.start, 1))),
        (Check::TensorReserved, Sealed(|b| first_record(b, tensor::RESERVED.end - 1, 1))),
        (Check::TensorRegion, Sealed(|b| first_record(b, tensor::REGION.start, 1))),
        (
            Check::TensorRegion,
            Parts(|p| {
                p.regions.push(fast());
                record(p, ids::KEY).region = 2;
            }),
        ),
        (
            Check::TensorInside,
            Parts(|p| {
                p.regions.push(Region { bytes: 16, ..fast() });
                record(p, ids::KEY).region = 1;
            }),
        ),
        (Check::TensorBatch, Sealed(|b| first_record(b, tensor::BATCH.start, 2))),
        (
            Check::TensorShape,
            Parts(|p| {
                record(p, ids::RGB).shape.width = 0;
                record(p, ids::RGB).bytes = 0;
            }),
        ),
        (Check::TensorShape, Parts(|p| scratch_record(p).shape.width = 1)),
        (Check::TensorBytes, Parts(|p| record(p, ids::RGB).bytes -= 1)),
        (Check::TensorBytes, Parts(|p| record(p, ids::STREAM).bytes += 16)),
        (Check::TensorBytes, Parts(|p| scratch_record(p).bytes = 0)),
        (Check::TensorAlignment, Parts(|p| record(p, ids::RGB).offset += 2)),
        (Check::TensorInside, Parts(|p| record(p, ids::KEY).offset = p.regions[0].bytes)),
        (Check::TensorInside, Parts(|p| record(p, ids::KEY).offset = 0xFFFF_FFF0)),
        (Check::TensorLive, Parts(|p| record(p, ids::KEY).last_step = STEPS as u16)),
        (Check::TensorLive, Parts(|p| record(p, ids::KEY).last_step = 6)),
        (Check::TensorWritten, Parts(|p| record(p, ids::KEY).first_step = 6)),
        (Check::TensorLastUse, Parts(|p| record(p, ids::KEY).last_step = 10)),
        (Check::TensorLastUse, Parts(|p| record(p, ids::VELOCITY).last_step = 3)),
        (Check::TensorOutputLive, Parts(|p| p.outputs.push(port("sum", ids::SUM)))),
        (Check::TensorInPlace, Parts(|p| record(p, ids::RGB).in_place_of = Some(TensorId(ids::LIDAR)))),
        (Check::TensorInPlace, Parts(|p| scratch_record(p).in_place_of = Some(TensorId(ids::LIDAR)))),
        (Check::ScratchOneStep, Parts(|p| scratch_record(p).last_step += 1)),
        (
            Check::PortText,
            Sealed(|b| {
                let ports = start(b, SectionKind::Ports);
                b[ports + layout::port::NAME.start] = 0xFF;
            }),
        ),
        (Check::PortScale, Parts(|p| p.inputs[0].scale = 0.0)),
        (Check::PortScale, Parts(|p| p.inputs[0].scale = f32::NAN)),
        (Check::PortScale, Parts(|p| p.outputs[0].scale = f32::INFINITY)),
        (Check::PortZeroPoint, Parts(|p| p.inputs[2].zero_point = 1)),
        (Check::PortZeroPoint, Parts(|p| p.inputs[0].zero_point = 128)),
        (Check::PortTensor, Parts(|p| p.outputs.push(port("none", 999)))),
        (Check::PortRepeated, Parts(|p| p.outputs.push(port("again", ids::WAYPOINTS)))),
        (Check::PortRepeated, Parts(|p| p.inputs.push(port("again", ids::RGB)))),
        (Check::InputFirstStep, Parts(|p| record(p, ids::LIDAR).first_step = 1)),
        (Check::InputOverlap, Parts(|p| record(p, ids::LIDAR).offset = record(p, ids::RGB).offset)),
    ]
}

fn memory_changes() -> Vec<(Check, Change)> {
    vec![
        (Check::StepTensor, Parts(|p| step!(p, at::LINEAR_QUERY, Linear, |s| s.input = TensorId(999)))),
        (
            Check::StepReadsScratch,
            Parts(|p| {
                let scratch = p.tensors.iter().position(|t| t.element == ElementType::Scratch).expect("scratch");
                step!(p, at::LINEAR_QUERY, Linear, |s| s.input = TensorId(scratch as u16));
            }),
        ),
        (Check::StepReadLive, Parts(|p| step!(p, at::LINEAR_QUERY, Linear, |s| s.input = TensorId(ids::HIDDEN)))),
        (Check::StepReadLive, Parts(|p| step!(p, at::LINEAR_QUERY, Linear, |s| s.input = TensorId(ids::LIDAR)))),
        (Check::StepReadLive, Parts(|p| step!(p, at::LINEAR_QUERY, Linear, |s| s.input = TensorId(ids::QUERY)))),
        (
            Check::StepWritesInput,
            Parts(|p| {
                to_fresh_memory(p, &[ids::STEM]);
                record(p, ids::POOLED).in_place_of = None;
                p.inputs.push(port("stem", ids::STEM));
            }),
        ),
        (
            Check::StepWritesOnce,
            Parts(|p| {
                to_fresh_memory(p, &[ids::KEY]);
                record(p, ids::KEY).first_step = 0;
                p.inputs.push(port("key", ids::KEY));
                step!(p, at::LINEAR_QUERY + 1, Linear, |s| s.output = TensorId(ids::QUERY));
            }),
        ),
        (Check::StepOverlap, Parts(|p| record(p, ids::NORMED).offset = record(p, ids::STREAM).offset)),
        (Check::StepOverlap, Parts(|p| record(p, ids::VECTOR).offset = record(p, ids::GOAL).offset)),
        (Check::StepOverlap, Parts(|p| scratch_record(p).offset = 0)),
        (
            Check::StepScratch,
            Parts(|p| {
                let attention = p.steps[at::ATTENTION].scratch();
                step!(p, at::LINEAR_WIDE, Linear, |s| s.scratch = attention);
            }),
        ),
        (
            Check::StepScratchBytes,
            Parts(|p| {
                let scratch = p.steps[at::ATTENTION].scratch().expect("attention has scratch");
                record(p, scratch.0).bytes -= 1;
            }),
        ),
        (
            Check::InPlaceOperand,
            Parts(|p| {
                to_fresh_memory(p, &[ids::HIDDEN, ids::VECTOR]);
                record(p, ids::HIDDEN).in_place_of = Some(TensorId(ids::VECTOR));
            }),
        ),
        (Check::InPlaceOnce, Parts(|p| step!(p, at::ADD, Add, |s| s.first.tensor = TensorId(ids::LIDAR_NARROW)))),
        (Check::InPlacePosition, Parts(|p| to_fresh_memory(p, &[ids::CONTEXT]))),
        (
            Check::InPlacePosition,
            Parts(|p| {
                p.regions.push(Region { bytes: p.regions[0].bytes, ..fast() });
                record(p, ids::CONTEXT).region = 1;
            }),
        ),
        (
            Check::StepOverlap,
            Parts(|p| {
                p.regions.push(Region { bytes: p.regions[0].bytes, ..fast() });
                (record(p, ids::NORMED).region, record(p, ids::STREAM).region) = (1, 1);
                record(p, ids::NORMED).offset = record(p, ids::STREAM).offset;
            }),
        ),
        (
            Check::InPlaceLastUse,
            Parts(|p| {
                to_fresh_memory(p, &[ids::POOLED, ids::FUSED, ids::SUM, ids::BLOCK]);
                record(p, ids::SUM).in_place_of = Some(TensorId(ids::FUSED));
                record(p, ids::POOLED).in_place_of = None;
            }),
        ),
        (
            Check::InPlaceOrder,
            Parts(|p| {
                to_fresh_memory(p, &[ids::STEM, ids::POOLED, ids::FUSED, ids::BLOCK]);
                record(p, ids::POOLED).in_place_of = Some(TensorId(ids::STEM));
                step!(p, at::MAX_POOL, MaxPool, |s| {
                    (s.window.kernel_h, s.window.kernel_w) = (5, 5);
                    (s.window.pad_top, s.window.pad_bottom) = (2, 2);
                    (s.window.pad_left, s.window.pad_right) = (2, 2);
                });
            }),
        ),
        (Check::ConstAligned, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.weights.offset += 8))),
        (Check::ConstInside, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.weights.offset += 1 << 20))),
        (Check::ConstInside, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.weights.offset = 0xFFFF_FFF0))),
        (Check::ConstLength, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.weights.bytes -= 1))),
        (Check::ConstLength, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.padding_codes.bytes += 1))),
        (Check::ConstLength, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.rescale.bias.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.rescale.multipliers.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.rescale.shifts.bytes -= 1))),
        (Check::ConstLength, Parts(|p| step!(p, at::LINEAR_QUERY, Linear, |s| s.weights.bytes -= 1))),
        (Check::ConstLength, Parts(|p| step!(p, at::RESIZE, ResizeBilinear, |s| s.rows.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::RESIZE, ResizeBilinear, |s| s.columns.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.velocity_multipliers.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.position.bytes -= 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::LAYER_NORM, LayerNorm, |s| s.gains.bytes -= 4))),
        (Check::ConstLength, Parts(|p| step!(p, at::LAYER_NORM, LayerNorm, |s| s.offsets.bytes -= 8))),
        (Check::ConstLength, Parts(|p| step!(p, at::ATTENTION, Attention, |s| s.exp_table.bytes -= 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::SOFTMAX, Softmax, |s| s.exp_table.bytes -= 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::BRANCH_LINEAR, BranchLinear, |s| s.weights.bytes -= 1))),
        (Check::ConstLength, Parts(|p| step!(p, at::BRANCH_LINEAR, BranchLinear, |s| s.rescale.bias.bytes = 12))),
        (Check::ConstLength, Parts(|p| step!(p, at::BRANCH_LINEAR, BranchLinear, |s| s.branches = 3))),
        (Check::ConstLength, Parts(|p| step!(p, at::SIGMOID, Sigmoid, |s| s.tanh_table.bytes -= 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::SPATIAL_SOFTMAX, SpatialSoftmax, |s| s.exp_table.bytes += 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.concat = true))),
        (Check::ConstLength, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.tanh_table.bytes -= 2))),
        (Check::ConstLength, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.biases.bytes -= 8))),
        (Check::ConstLength, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.output_bias.bytes -= 8))),
    ]
}

fn operator_changes() -> Vec<(Check, Change)> {
    vec![
        (
            Check::StepElement,
            Parts(|p| {
                record(p, ids::GOAL).element = ElementType::I16;
                record(p, ids::GOAL).bytes = 4;
            }),
        ),
        (
            Check::StepShape,
            Parts(|p| {
                record(p, ids::VELOCITY).shape = Shape::vector(2);
                record(p, ids::VELOCITY).bytes = 4;
            }),
        ),
        (
            Check::StepShape,
            Parts(|p| {
                record(p, ids::WAYPOINTS).shape = Shape::tokens(2, 4);
            }),
        ),
        (Check::StepWindow, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.window.stride_h = 2))),
        (Check::StepWindow, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.window.stride_w = 0))),
        (Check::StepWindow, Parts(|p| step!(p, at::MAX_POOL, MaxPool, |s| s.window.kernel_h = 9))),
        (
            Check::StepDilation,
            Parts(|p| {
                step!(p, at::MAX_POOL, MaxPool, |s| {
                    (s.window.dilation_h, s.window.pad_bottom) = (2, 1);
                    (s.window.dilation_w, s.window.pad_right) = (2, 1);
                })
            }),
        ),
        (
            Check::StepPadding,
            Parts(|p| step!(p, at::MAX_POOL, MaxPool, |s| (s.window.stride_h, s.window.pad_top) = (3, 3))),
        ),
        (
            Check::StepPadding,
            Parts(|p| step!(p, at::AVERAGE_POOL, AveragePool, |s| (s.window.stride_h, s.window.pad_top) = (3, 1))),
        ),
        (Check::StepGroups, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.groups = 3))),
        (Check::StepGroups, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.groups = 0))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.input_zero_point = 1))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.zero_point = 128))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::ADD, Add, |s| s.first.zero_point = -129))),
        (Check::StepClamp, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.clamp.min = -129))),
        (Check::StepClamp, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.clamp.max = 128))),
        (Check::StepClamp, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.clamp = Clamp { min: 1, max: 0 }))),
        (Check::StepPreShift, Parts(|p| step!(p, at::CONV, Conv2d, |s| s.rescale.pre_shift = 37))),
        (Check::StepPreShift, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.hidden_pre_shift = 37))),
        (Check::StepShift, Parts(|p| step!(p, at::ADD, Add, |s| s.shift = 41))),
        (Check::StepShift, Parts(|p| step!(p, at::GLOBAL_POOL, GlobalPool, |s| s.shift = 41))),
        (Check::StepShift, Parts(|p| step!(p, at::RESIZE, ResizeBilinear, |s| s.shift = 41))),
        (Check::StepShift, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.shift = 41))),
        (Check::StepShift, Parts(|p| step!(p, at::LAYER_NORM, LayerNorm, |s| s.shift = 41))),
        (Check::StepShift, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.requant.shift = 0))),
        (Check::StepShift, Parts(|p| step!(p, at::ATTENTION, Attention, |s| s.exponent.shift = 53))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::REQUANTIZE, Requantize, |s| s.requant.multiplier = 1 << 24))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::AVERAGE_POOL, AveragePool, |s| s.requant.multiplier = 0))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::ADD, Add, |s| s.second.multiplier = -1))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.first.multiplier = -1))),
        (Check::StepWeightBits, Parts(|p| step!(p, at::RESIZE, ResizeBilinear, |s| s.weight_bits = 3))),
        (Check::StepWeightBits, Parts(|p| step!(p, at::RESIZE, ResizeBilinear, |s| s.weight_bits = 12))),
        (
            Check::StepFactor,
            Parts(|p| {
                record(p, ids::GRID).shape = Shape::map(1, 3, 8);
                record(p, ids::GRID).bytes = 24;
            }),
        ),
        (Check::StepTokenPool, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.first.pool_h = 3))),
        (Check::StepTokenPool, Parts(|p| step!(p, at::TOKENS, Tokens, |s| s.second.pool_w = 0))),
        (Check::StepEpsilon, Parts(|p| step!(p, at::LAYER_NORM, LayerNorm, |s| s.epsilon = 0))),
        (Check::StepRows, Parts(|p| step!(p, at::LAYER_NORM_ROWS, LayerNorm, |s| s.first_row = 5))),
        (Check::StepChannels, Parts(wide_hidden_state)),
        (Check::StepTokens, Parts(|p| *p = attention_alone(513, 8, 2))),
        (Check::StepHeads, Parts(|p| step!(p, at::ATTENTION, Attention, |s| s.heads = 3))),
        (Check::StepHeads, Parts(|p| step!(p, at::ATTENTION, Attention, |s| s.heads = 0))),
        (Check::StepHeads, Parts(|p| *p = attention_alone(4, 1026, 2))),
        (Check::StepFraction, Parts(|p| step!(p, at::DECODER, WaypointDecoder, |s| s.hidden_fraction_bits = 16))),
        (
            Check::StepElement,
            Parts(|p| {
                to_fresh_memory(p, &[ids::PROBABILITIES]);
                let probabilities = record(p, ids::PROBABILITIES);
                (probabilities.in_place_of, probabilities.element) = (None, ElementType::I8);
                probabilities.bytes /= 2;
            }),
        ),
        (Check::StepShape, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.axis = Axis::Width))),
        (Check::StepShape, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.axis = Axis::Channels))),
        (Check::StepShape, Parts(|p| record(p, ids::JOINED).shape = Shape::map(4, 7, 8))),
        (Check::StepShape, Parts(|p| record(p, ids::PROBABILITIES).shape = Shape::map(4, 7, 8))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.second.zero_point = 128))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.zero_point = 1))),
        (Check::StepClamp, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.clamp = Clamp { min: 1, max: 0 }))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.first.requant.multiplier = 1))),
        (Check::StepShift, Parts(|p| step!(p, at::CONCAT, Concat, |s| s.second.requant.shift = 0))),
        (Check::StepShift, Parts(|p| step!(p, at::SOFTMAX, Softmax, |s| s.exponent.shift = 53))),
        (Check::StepShift, Parts(|p| step!(p, at::SPATIAL_SOFTMAX, SpatialSoftmax, |s| s.exponent.shift = 0))),
        (
            Check::StepMultiplier,
            Parts(|p| step!(p, at::SPATIAL_SOFTMAX, SpatialSoftmax, |s| s.exponent.multiplier = 1)),
        ),
        (
            Check::StepElement,
            Parts(|p| step!(p, at::SPATIAL_SOFTMAX, SpatialSoftmax, |s| s.input = TensorId(ids::WAYPOINTS))),
        ),
        (Check::StepShape, Parts(|p| record(p, ids::POINTS).shape = Shape::tokens(4, 4))),
        (Check::StepPixels, Parts(|p| *p = spatial_softmax_alone(Shape::map(1, 257, 2)))),
        (Check::StepPixels, Parts(|p| *p = spatial_softmax_alone(Shape::map(257, 256, 1)))),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.begin[0] = 2))),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.stride[2] = 6))),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.stride[1] = 0))),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.size[1] = 0))),
        (
            Check::StepBox,
            Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| (s.size, s.stride) = ([u16::MAX; 3], [u16::MAX; 3]))),
        ),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.before[2] = 7))),
        (Check::StepBox, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.before[0] = u16::MAX))),
        (Check::StepBorder, Parts(|p| step!(p, at::COPY_BOX, CopyBox, |s| s.border = -129))),
        (Check::StepChannels, Parts(|p| *p = softmax_alone(32769))),
        (
            Check::StepElement,
            Parts(|p| {
                to_fresh_memory(p, &[ids::CELLS]);
                record(p, ids::CELLS).element = ElementType::I16;
                record(p, ids::CELLS).bytes *= 2;
            }),
        ),
        (Check::StepShape, Parts(|p| record(p, ids::CELLS).shape = Shape::map(3, 2, 6))),
        (Check::StepShape, Parts(|p| record(p, ids::CELLS).shape = Shape::map(2, 2, 9))),
        (Check::StepShape, Parts(|p| record(p, ids::CELLS).shape = Shape::map(4, 3, 3))),
        (Check::StepShape, Parts(odd_indices)),
        (Check::StepShape, Parts(|p| record(p, ids::GATHERED).shape = Shape::map(2, 6, 4))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::GATHER_SUM, GatherSum, |s| s.input_zero_point = 128))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::GATHER_SUM, GatherSum, |s| s.zero_point = 1))),
        (Check::StepClamp, Parts(|p| step!(p, at::GATHER_SUM, GatherSum, |s| s.clamp = Clamp { min: 1, max: 0 }))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::GATHER_SUM, GatherSum, |s| s.requant.multiplier = 1 << 24))),
        (Check::StepShift, Parts(|p| step!(p, at::GATHER_SUM, GatherSum, |s| s.requant.shift = 0))),
        (Check::StepBranches, Parts(|p| step!(p, at::BRANCH_LINEAR, BranchLinear, |s| s.branches = 0))),
        (Check::StepBranches, Parts(|p| step!(p, at::BRANCH_LINEAR, BranchLinear, |s| s.branches = 128))),
        (
            Check::StepResidual,
            Parts(|p| {
                step!(p, at::BRANCH_LINEAR, BranchLinear, |s| {
                    s.rescale.residual = Residual::Stream { tensor: s.output };
                });
            }),
        ),
        (
            Check::StepElement,
            Parts(|p| {
                let command = record(p, ids::COMMAND);
                (command.element, command.bytes) = (ElementType::I16, 2);
            }),
        ),
        (Check::StepShift, Parts(|p| step!(p, at::SIGMOID, Sigmoid, |s| s.requant.shift = 0))),
        (Check::StepMultiplier, Parts(|p| step!(p, at::SIGMOID, Sigmoid, |s| s.requant.multiplier = 1 << 24))),
        (Check::StepZeroPoint, Parts(|p| step!(p, at::SIGMOID, Sigmoid, |s| s.input_zero_point = 1))),
        (Check::Work, Parts(|p| *p = endless_convolution())),
    ]
}

/// A decoder over a hidden state of 1025 values.
fn wide_hidden_state(parts: &mut ImageParts) {
    to_fresh_memory(parts, &[ids::HIDDEN]);
    record(parts, ids::HIDDEN).shape = Shape::vector(1025);
    record(parts, ids::HIDDEN).bytes = 2050;
    parts.constants.resize(parts.constants.len() + 16384, 0);
    step!(parts, at::LINEAR_WIDE, Linear, |s| {
        s.weights.bytes = 8200;
        s.rescale.bias.bytes = 4100;
        s.rescale.multipliers.bytes = 4100;
        s.rescale.shifts.bytes = 1025;
    });
}

/// A list of cells that ends with half a pair.
fn odd_indices(parts: &mut ImageParts) {
    to_fresh_memory(parts, &[ids::CELLS]);
    record(parts, ids::CELLS).shape = Shape::map(2, 3, 5);
    record(parts, ids::CELLS).bytes = 30;
}

/// One softmax over an input.
fn softmax_alone(channels: u16) -> ImageParts {
    let mut parts = attention_alone(8, 8, 2);
    let bytes = 2 * u32::from(channels);
    let (element, shape) = (ElementType::I16, Shape::vector(channels));
    let tensor = |offset| TensorRecord { element, shape, offset, bytes, ..parts.tensors[0] };
    let behind = bytes.next_multiple_of(16);
    parts.tensors = vec![tensor(0), tensor(behind)];
    parts.regions[0].bytes = 2 * behind;
    parts.inputs = vec![port("x", 0)];
    parts.outputs = vec![port("y", 1)];
    step!(parts, 0, Attention, |s| {
        parts.steps = vec![Step::Softmax(Softmax {
            input: TensorId(0),
            output: TensorId(1),
            exponent: s.exponent,
            exp_table: s.exp_table,
        })];
    });
    parts
}

/// One spatial softmax over an input.
fn spatial_softmax_alone(shape: Shape) -> ImageParts {
    let mut parts = softmax_alone(1);
    let (input, output) = (2 * shape.elements() as u32, 8 * u32::from(shape.channels));
    let points = Shape::tokens(shape.channels, 2);
    parts.tensors[0] = TensorRecord { shape, bytes: input, ..parts.tensors[0] };
    let (element, offset) = (ElementType::I32, input.next_multiple_of(16));
    parts.tensors[1] = TensorRecord { element, shape: points, offset, bytes: output, ..parts.tensors[1] };
    parts.regions[0].bytes = offset + output.next_multiple_of(16);
    step!(parts, 0, Softmax, |s| {
        let (exponent, exp_table) = (s.exponent, s.exp_table);
        parts.steps =
            vec![Step::SpatialSoftmax(SpatialSoftmax { input: s.input, output: s.output, exponent, exp_table })];
    });
    parts
}

/// Three inputs and one attention.
fn attention_alone(tokens: u16, channels: u16, heads: u16) -> ImageParts {
    let mut parts = sample_image::parts();
    let bytes = u32::from(tokens) * u32::from(channels);
    let stride = bytes.next_multiple_of(16);
    let tensor = |offset| TensorRecord {
        element: ElementType::I8,
        shape: Shape::tokens(tokens, channels),
        region: 0,
        offset,
        bytes,
        first_step: 0,
        last_step: 0,
        in_place_of: None,
    };
    let scratch = plan::attention_scratch_bytes(tokens.into(), channels, heads);
    parts.tensors = (0..4).map(|i| tensor(i * stride)).chain([TensorRecord::scratch(4 * stride, scratch, 0)]).collect();
    parts.regions[0].bytes = 4 * stride + scratch.next_multiple_of(16);
    parts.inputs = vec![port("q", 0), port("k", 1), port("v", 2)];
    parts.outputs = vec![port("y", 3)];
    step!(parts, at::ATTENTION, Attention, |s| {
        (s.query, s.key, s.value) = (TensorId(0), TensorId(1), TensorId(2));
        (s.output, s.scratch, s.heads) = (TensorId(3), Some(TensorId(4)), heads);
    });
    parts.steps = vec![parts.steps[at::ATTENTION].clone()];
    parts.known_answer = None;
    parts
}

/// One convolution of 2^30 outputs with 2^16 products each.
fn endless_convolution() -> ImageParts {
    let mut parts = attention_alone(8, 8, 2);
    let side = 32_767_u16;
    let shape = Shape::map(side, side, 1);
    let window = Window::square(255, 1, 127);
    let scratch = plan::conv2d_scratch_bytes(KernelId::Direct, shape, shape, window, 1);
    let map = 1 << 30;
    let tensor = |offset| TensorRecord { shape, offset, bytes: shape.elements() as u32, ..parts.tensors[0] };
    parts.tensors = vec![tensor(0), tensor(map), TensorRecord::scratch(2 * map, scratch, 0)];
    parts.regions[0].bytes = 2 * map + scratch.next_multiple_of(16);
    parts.inputs = vec![port("x", 0)];
    parts.outputs = vec![port("y", 1)];
    parts.constants = vec![0; 255 * 255 + 15];
    let range = |bytes| ConstRange { offset: 0, bytes };
    parts.steps = vec![Step::Conv2d(Conv2d {
        input: TensorId(0),
        output: TensorId(1),
        window,
        groups: 1,
        kernel: KernelId::Direct,
        weights: range(255 * 255),
        padding_codes: range(1),
        rescale: Rescale {
            pre_shift: 0,
            bias: range(4),
            multipliers: range(4),
            shifts: range(1),
            zero_point: 0,
            clamp: Clamp { min: 0, max: 127 },
            residual: Residual::None,
        },
        scratch: Some(TensorId(2)),
    })];
    parts
}

fn changes() -> Vec<(Check, Change)> {
    [header_changes(), section_changes(), table_changes(), memory_changes(), operator_changes()]
        .into_iter()
        .flatten()
        .collect()
}

fn changed(change: &Change) -> AlignedBytes {
    let mut parts = sample_image::parts();
    if let Parts(edit) = change {
        edit(&mut parts);
    }
    let mut bytes = assemble(&parts).expect("fits the format");
    match change {
        Parts(_) => {}
        Sealed(edit) => {
            edit(&mut bytes);
            reseal(&mut bytes);
        }
        Raw(edit) => edit(&mut bytes),
    }
    AlignedBytes::from(bytes.as_slice())
}

/// One test, since the switch that disables a check is global.
#[test]
fn every_check_refuses_its_change_and_nothing_else_does_before_it() {
    let mut accepted_without = Vec::new();
    let mut wrong = Vec::new();
    for (number, (check, change)) in changes().iter().enumerate() {
        let bytes = changed(change);
        disable_check(0);
        match Image::parse(&bytes) {
            Ok(_) => wrong.push(format!("change {number} for {check:?} was accepted")),
            Err(error) if error.check != *check => wrong.push(format!("change {number} for {check:?}: {error:?}")),
            Err(error) => assert!(error.to_string().contains(check.words()), "{error}"),
        }
        disable_check(check.number());
        let unguarded: Result<Image<'_>, ParseError> = Image::parse(&bytes);
        match unguarded {
            Ok(_) => accepted_without.push(*check),
            Err(error) => assert_ne!(error.check, *check, "change {number}: the check was not disabled"),
        }
        disable_check(0);
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    accepted_without.dedup();
    println!("accepted without their check: {accepted_without:?}");
    let covered = |check: &Check| *check == Check::Misaligned || changes().iter().any(|(c, _)| c == check);
    let missing: Vec<_> = Check::ALL.iter().filter(|check| !covered(check)).collect();
    assert!(missing.is_empty(), "no change for {missing:?}");
    assert!(accepted_without.len() > 20, "{accepted_without:?}");
}

#[test]
fn numbers_of_checks_are_their_positions() {
    for (position, check) in Check::ALL.iter().enumerate() {
        assert_eq!(usize::from(check.number()), position + 1);
        assert!(!check.words().is_empty());
    }
}
