//! One file per system, over shared parts: the tensor list with its problems, the graph builder, ResNet, transformer,
//! head.
//!
//! A further system is one more file with `recognize` and `build`, and its line in the two tables here.

use super::{ImportOptions, NamedTensors, System};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::Graph;
use builder::Builder;

mod aim;
mod bottleneck;
mod builder;
mod cilrs;
mod deeplab;
mod detect;
mod geometric_fusion;
mod head;
mod late_fusion;
mod lbc;
mod resnet;
mod transformer;
mod transfuser;
mod weights;

pub(super) use weights::oihw_to_ohwi;

/// Height and width of camera crop and LiDAR histogram as published, pixels.
const DEFAULT_RESOLUTION: (u16, u16) = (256, 256);

/// Whether some tensor is named like this.
fn has(tensors: &NamedTensors, prefix: &str) -> bool {
    tensors.under(prefix).next().is_some()
}

/// The system of these names. The order matters: some systems' names include those of a simpler one.
pub(super) fn detect(tensors: &NamedTensors) -> Option<System> {
    let recognized: [(System, bool); 7] = [
        (System::Lbc, lbc::recognize(tensors)),
        (System::Cilrs, cilrs::recognize(tensors)),
        // Its convolutions are named like those of Geometric Fusion.
        (System::TransFuser, transformer::is_shared(tensors)),
        (System::GeometricFusion, geometric_fusion::recognize(tensors)),
        (System::TransFuser, transfuser::recognize(tensors)),
        (System::LateFusion, late_fusion::recognize(tensors)),
        (System::Aim, aim::recognize(tensors)),
    ];
    recognized.into_iter().find(|(_, found)| *found).map(|(system, _)| system)
}

/// Builds the graph of this system, or lists what is wrong with the tensors.
pub(super) fn build(system: System, name: &str, tensors: NamedTensors, options: &ImportOptions) -> Result<Graph> {
    let recipe: fn(&mut Builder<'_>) -> Result<()> = match system {
        System::Aim => aim::build,
        System::LateFusion => late_fusion::build,
        System::TransFuser => transfuser::build,
        System::GeometricFusion => geometric_fusion::build,
        System::Cilrs => cilrs::build,
        System::Lbc => lbc::build,
    };
    if options.fusion_scales.is_some() && system != System::GeometricFusion {
        let message = format!("--fusion-scales has no effect on {}", system.name());
        return Err(Error::new(ErrorCode::Usage, "", message)
            .with_help("leave it out; the tensors of other systems tell their scales"));
    }
    if let Some(scales) = options.fusion_scales.filter(|scales| !(1..=4).contains(scales)) {
        let message = format!("--fusion-scales: found {scales}, expected 1 to 4");
        return Err(Error::new(ErrorCode::Usage, "", message)
            .with_help("it counts the stages that are fused, from the last; leave it out where all are"));
    }
    if system != System::Lbc && (options.hack || options.temperature.is_some()) {
        let message = format!("--hack and --temperature have no effect on {}", system.name());
        return Err(Error::new(ErrorCode::Usage, "", message).with_help("leave them out; they belong to lbc"));
    }
    let mut builder = Builder::new(name, system, tensors, options);
    let built = recipe(&mut builder);
    builder.finish(built)
}
