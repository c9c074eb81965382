//! What the fusing transformer of TransFuser attends to: how often a token of one sensor looks at the other sensor.
//!
//! The figures of the paper, of the integers that drive and of the f32 network beside them:
//! * [`block`] finds one attention block in an image or in a graph, and the token grids of its two sensors
//! * [`integers`] takes the softmax rows from the engine, [`float`] from the f32 network; both give an [`AttentionMap`]
//! * [`queries`] says which tokens are asked, [`statistics`] counts where their strongest keys lie and how far both
//!   networks agree
//!
//! ```text
//! frame ─┬► engine ─► codes of q and k ─► e_j, proven on v and the context ─┐
//!        └► f32 reference ─► q and k ─► softmax ────────────────────────────┴► strongest keys ─► figures
//! ```

use crate::backends::Backend;
use crate::files::{self, FrameSource, ImageFile};
use crate::gates::{self, GateOutcome};
use crate::report::json;
use crate::run::ModelInfo;
use crate::verify::calibration_digests;
use block::{BlockChoice, FloatBlock, IntegerBlock};
use float::FloatAttention;
use indicatif::ProgressBar;
use integers::IntegerAttention;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use queries::{Queries, QueryRows};
use schemars::JsonSchema;
use serde::Serialize;
use statistics::{Agreement, AgreementCounts, Counts, Statistics, StrongestKeys};
use std::path::PathBuf;

pub mod block;
pub mod float;
pub mod integers;
pub mod queries;
pub mod statistics;

/// Softmax rows of one attention block on one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct AttentionMap {
    /// T.
    pub tokens: usize,
    /// Number of heads.
    pub heads: usize,
    /// By query, head and key. Only the weights of one row compare: integers are not divided by their sum.
    pub weights: Vec<f32>,
}

impl AttentionMap {
    /// Weights of all keys for one query of one head.
    pub fn row(&self, head: usize, query: usize) -> &[f32] {
        &self.weights[(query * self.heads + head) * self.tokens..][..self.tokens]
    }
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct Options {
    /// Model image, or a checkpoint.
    pub model: PathBuf,
    /// The checkpoint that the image was compiled from.
    pub checkpoint: Option<PathBuf>,
    /// Build record of the image, for the names of its blocks; the one beside the image if not given.
    pub record: Option<PathBuf>,
    /// How the checkpoint is read.
    pub import: ImportOptions,
    /// Frames to run.
    pub frames: FrameSource,
    /// Kernels of the engine.
    pub backend: Backend,
    /// Which attention block.
    pub block: BlockChoice,
    /// Which queries.
    pub rows: QueryRows,
    /// Strongest keys of each query and head; 5 if not given, fewer where a sensor has fewer tokens.
    pub top: Option<u16>,
    /// Fewest of the strongest keys that both networks must have in common, percent.
    pub min_agreement_percent: Option<f64>,
}

/// Result of the measurement.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct AttentionReport {
    /// Version of this structure.
    pub schema: u32,
    /// The attention block.
    pub block: String,
    /// Its heads.
    pub heads: u16,
    /// Strongest keys taken of each query and head.
    pub top: u16,
    /// Which tokens were asked.
    pub queries: Queries,
    /// The integers of the image, if there is one.
    pub int8: Option<NetworkAttention>,
    /// The f32 network, if there is one.
    #[serde(rename = "f32")]
    pub float: Option<NetworkAttention>,
    /// How far both agree.
    pub agreement: Option<Agreement>,
    /// Frames that the image was calibrated on, too: the agreement on them flatters.
    pub calibration_frames: Vec<String>,
    /// Every frame, in order.
    pub frames: Vec<FrameAttention>,
    /// The gate on the agreement, where one was asked for.
    pub gates: Vec<GateOutcome>,
    /// Why the gate was missed; absent where it was not.
    #[serde(rename = "error", skip_serializing_if = "Option::is_none", serialize_with = "json::failure")]
    #[schemars(with = "json::Failure")]
    pub failure: Option<Error>,
}

/// One of the two networks.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct NetworkAttention {
    /// Which.
    pub model: ModelInfo,
    /// Its figures.
    pub statistics: Statistics,
}

/// The strongest keys on one frame.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct FrameAttention {
    /// Frame.
    pub name: String,
    /// Of the integers.
    pub int8: Option<StrongestKeys>,
    /// Of the f32 network.
    #[serde(rename = "f32")]
    pub float: Option<StrongestKeys>,
    /// How far both agree on this frame.
    pub agreement: Option<Agreement>,
}

/// A report, and the frames that it is about.
#[derive(Clone, Debug)]
pub struct Measured {
    /// What was found.
    pub report: AttentionReport,
    /// Every frame, in order.
    pub frames: Vec<Frame>,
}

/// Runs the frames and counts.
///
/// # Errors
/// A file cannot be read, the files do not belong together, the network fuses no sensors, a row or the number of keys
/// is out of range; [`ErrorCode::Check`] where the rows do not explain the engine's bytes. A missed gate is in the
/// report, no error.
pub fn attention(options: &Options, progress: &ProgressBar) -> Result<Measured> {
    let file = match files::is_image_file(&options.model)? {
        true => Some(ImageFile::read(&options.model)?),
        false => None,
    };
    let image = file.as_ref().map(ImageFile::parse).transpose()?;
    let record = match file.as_ref().map(|file| file.record(options.record.as_deref())) {
        Some(Err(error)) if error.code == ErrorCode::Io && options.record.is_none() => None,
        record => record.transpose()?,
    };
    let checkpoint = match (&file, &options.checkpoint) {
        (None, Some(_)) => {
            let error = Error::new(ErrorCode::Usage, options.model.display().to_string(), "this is no model image");
            return Err(error.with_help("--model goes with an image; give a checkpoint alone, without --model"));
        }
        (None, None) => Some(&options.model),
        (Some(_), checkpoint) => checkpoint.as_ref(),
    };
    let graph = checkpoint.map(|path| files::load_graph(path, &options.import)).transpose()?;

    let within_model = |e: Error| e.within(options.model.display());
    let find = |image| IntegerBlock::find(image, record.as_ref(), &options.block);
    let integer_block = image.as_ref().map(find).transpose().map_err(within_model)?;
    let find =
        |(graph, path): (_, &PathBuf)| FloatBlock::find(graph, &options.block).map_err(|e| e.within(path.display()));
    let float_block = graph.as_ref().zip(checkpoint).map(find).transpose()?;
    let block = block::common(integer_block.as_ref(), float_block.as_ref())?;
    let queries = Queries::new(&options.rows, block.grids)?;
    let top = queries::top(options.top, block.grids)?;
    let format = match (&graph, &image) {
        (Some(graph), _) => FrameFormat::of_graph(graph),
        (None, Some(image)) => files::frame_format(image)?,
        (None, None) => unreachable!("the model is an image or a checkpoint"),
    };
    let frames = options.frames.load(&format)?;

    let mut int8 = match (image, integer_block) {
        (Some(image), Some(block)) => Some(IntegerAttention::new(image, block, options.backend).map_err(within_model)?),
        _ => None,
    };
    let float = float_block.map(FloatAttention::new);
    let (mut int8_counts, mut float_counts) = (Counts::default(), Counts::default());
    let mut agreement = AgreementCounts::default();
    let mut results = Vec::new();
    progress.set_length(frames.len() as u64);
    for frame in &frames {
        progress.set_message(frame.name.clone());
        let within = |e: Error| e.within(format!("frame {}", frame.name));
        let strongest = |map: AttentionMap| StrongestKeys::of(&map, &queries, top);
        let int8 = int8.as_mut().map(|int8| int8.map(frame).map(strongest)).transpose().map_err(within)?;
        let float = float.as_ref().map(|float| float.map(frame).map(strongest)).transpose().map_err(within)?;
        int8.iter().for_each(|keys| int8_counts.add(keys, &queries));
        float.iter().for_each(|keys| float_counts.add(keys, &queries));
        let both = int8.as_ref().zip(float.as_ref()).map(|(int8, float)| AgreementCounts::of(int8, float));
        both.iter().for_each(|counts| agreement.add(*counts));
        let agreement = both.map(AgreementCounts::figures);
        results.push(FrameAttention { name: frame.name.clone(), int8, float, agreement });
        progress.inc(1);
    }
    progress.finish_and_clear();

    let int8 = file.as_ref().zip(image).map(|(file, image)| NetworkAttention {
        model: ModelInfo { name: image.name().to_owned(), sha256: artifact::hex(&file.sha256()) },
        statistics: int8_counts.figures(),
    });
    let float = match (&graph, checkpoint) {
        (Some(graph), Some(path)) => Some(NetworkAttention {
            model: ModelInfo { name: graph.name.clone(), sha256: files::file_sha256(path)? },
            statistics: float_counts.figures(),
        }),
        _ => None,
    };
    let known = record.as_ref().map(|record| calibration_digests(&record.model)).unwrap_or_default();
    let overlap = frames::overlap(&known, &frames).into_iter().map(str::to_owned).collect();
    let mut report = AttentionReport {
        schema: json::SCHEMA,
        block: block.name,
        heads: block.heads,
        top,
        queries,
        agreement: (int8.is_some() && float.is_some()).then(|| agreement.figures()),
        int8,
        float,
        calibration_frames: overlap,
        frames: results,
        gates: Vec::new(),
        failure: None,
    };
    if let Some(limit) = options.min_agreement_percent {
        report.gates.push(gates::attention_agreement(&report, limit)?);
        report.failure = gates::failure(&report.gates);
    }
    Ok(Measured { report, frames })
}
