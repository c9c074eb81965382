//! The command line: `quantize`, `compile`, `convert`, `inspect`, `completions`.
//!
//! Results go to stdout, everything else to stderr. Exit status: 0 success, 1 a check failed, 2 bad input or usage.

use crate::artifact;
use crate::error::{Error, ErrorCode, Result};
use crate::frames::{self, FrameFormat};
use crate::import::ImportOptions;
use crate::ir::{Graph, Normalization};
use crate::memory_plan::PlanOptions;
use crate::passes::PassOptions;
use crate::pipeline;
use crate::qmodel::QModel;
use crate::quantize::{QuantizeOptions, RangeRule, SkipStages};
use crate::target::{Region, Target, parse_size};
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

mod completions;
mod console;
mod convert;
mod diff;
mod examples;
mod inspect;
mod progress;

pub use completions::CompletionArgs;
pub use console::Console;
use convert::FormArgs;
use progress::Bar;
pub use progress::progress_bar;

/// Trained driving networks to int8 model images.
#[derive(Debug, Parser)]
#[command(version, about, after_help = examples::ALL)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Checkpoint or ONNX file to quantized model (.qmodel): integers, scales and tables, independent of any target.
    #[command(after_help = examples::QUANTIZE)]
    Quantize {
        /// Checkpoint (.pth, .pt, .th, .safetensors) or ONNX file.
        model: PathBuf,
        #[command(flatten)]
        quantize: QuantizeArgs,
        /// Output file.
        #[arg(short, long, value_name = "FILE.qmodel")]
        output: PathBuf,
    },
    /// Quantized model, checkpoint or ONNX file to model image (OUT.img) and build record (OUT.record).
    #[command(after_help = examples::COMPILE)]
    Compile {
        /// Quantized model (.qmodel), checkpoint or ONNX file.
        model: PathBuf,
        #[command(flatten)]
        quantize: QuantizeArgs,
        #[command(flatten)]
        target: TargetArgs,
        /// Revision of the model: an update in the field refuses a lower one than it runs.
        #[arg(long, default_value_t = 0, value_name = "N")]
        revision: u32,
        #[command(flatten)]
        forms: FormArgs,
        /// Output file; the record gets the same name with the extension .record.
        #[arg(short, long, value_name = "OUT.img")]
        output: PathBuf,
    },
    /// Model image in another form: Intel HEX, S-records, ELF object, Rust source.
    #[command(after_help = examples::CONVERT)]
    Convert {
        /// Model image (.img).
        image: PathBuf,
        #[command(flatten)]
        forms: FormArgs,
        /// Output file.
        #[arg(short, long, value_name = "OUT")]
        output: PathBuf,
    },
    /// What is in a file: image, quantized model, checkpoint or ONNX file.
    #[command(after_help = examples::INSPECT)]
    Inspect {
        /// The file.
        file: PathBuf,
        /// Earlier image: say what changed from it to the file. Exit status 1 where they are not equal.
        #[arg(long, value_name = "BEFORE.img")]
        diff: Option<PathBuf>,
        /// The changes as JSON.
        #[arg(long, requires = "diff")]
        json: bool,
    },
    /// Script that completes commands and options in a shell.
    #[command(after_help = examples::COMPLETIONS)]
    Completions(CompletionArgs),
}

#[derive(Debug, Args)]
struct QuantizeArgs {
    /// Calibration frames: a frame directory (for classifiers: of images) or a .safetensors file of raw inputs.
    #[arg(long, value_name = "FRAMES|FILE")]
    calib: Option<PathBuf>,
    #[command(flatten)]
    resize: ResizeArgs,
    #[command(flatten)]
    import: ImportArgs,
    /// Skip values of the ResNets: i8, i16, or a list of 16-bit stages (0 is the stem).
    #[arg(long, default_value = "i8", value_name = "i8|i16|LIST")]
    skip: SkipStages,
    /// Clipping ranges of the i8 activations.
    #[arg(long, value_enum, default_value = "mse")]
    ranges: Ranges,
    /// Round every weight to its nearest integer.
    #[arg(long)]
    no_data_aware_rounding: bool,
    /// Leave biases as they are.
    #[arg(long)]
    no_bias_correction: bool,
    /// Fastest velocity to be driven, m/s: the token streams leave room for it.
    #[arg(long, default_value_t = 10.0, value_name = "M/S", value_parser = positive)]
    max_velocity: f64,
}

/// How images of another size become a classifier's input.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Args)]
pub struct ResizeArgs {
    /// Scale every image of a classifier's directory to this shorter side, then crop its center; without it all have
    /// the network's size. ImageNet networks: 256 for 224x224.
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u16).range(1..))]
    pub resize: Option<u16>,
}

/// How a checkpoint or an ONNX file is read where it cannot tell.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// System of a checkpoint; detected from the tensor names unless given.
    #[arg(long, value_name = "SYSTEM")]
    system: Option<String>,
    /// Attention heads of a checkpoint (no tensor tells) [default: 4].
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    heads: Option<u16>,
    /// Stages that a Geometric Fusion checkpoint fuses, counted from the last (no tensor tells) [default: 4].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=4))]
    fusion_scales: Option<u8>,
    /// Height and width of the network's image, views and BEV inputs; told from the file where it tells it, else as
    /// published: 256x256, of lbc 144x256; an ONNX file of dynamic size needs it.
    #[arg(long, value_name = "HxW")]
    resolution: Option<Resolution>,
    /// Mean of an ONNX network's image, one value or one per channel: the network reads (grey level * SCALE - MEAN) /
    /// STD [default: ImageNet's 0.485,0.456,0.406 for RGB, 0 for grey].
    #[arg(
        long,
        value_name = "R,G,B",
        value_delimiter = ',',
        value_parser = finite,
        allow_hyphen_values = true,
        requires = "std"
    )]
    mean: Option<Vec<f64>>,
    /// Standard deviation, like --mean [default: ImageNet's 0.229,0.224,0.225 for RGB, 1 for grey].
    #[arg(long, value_name = "R,G,B", value_delimiter = ',', value_parser = positive, requires = "mean")]
    std: Option<Vec<f64>>,
    /// Factor of the grey levels before --mean and --std: a number or a fraction [default: 1/255].
    #[arg(long, value_parser = fraction, requires = "mean")]
    scale: Option<f64>,
    /// Checkpoint of lbc: the network was trained on views of half the size (its hyper-parameter of this name).
    #[arg(long)]
    hack: bool,
    /// Checkpoint of lbc: what divides the logits before the spatial softmax [default: 5].
    #[arg(long, value_parser = positive)]
    temperature: Option<f64>,
}

/// `HEIGHTxWIDTH`.
#[derive(Clone, Copy, Debug)]
pub struct Resolution(pub u16, pub u16);

impl std::str::FromStr for Resolution {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let parse = |s: &str| s.parse::<u16>().ok().filter(|&v| v > 0);
        match text.split_once('x').map(|(h, w)| (parse(h), parse(w))) {
            Some((Some(h), Some(w))) => Ok(Self(h, w)),
            _ => Err(format!("found {text:?}, expected HEIGHTxWIDTH such as 256x256")),
        }
    }
}

fn positive(text: &str) -> std::result::Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|v| v.is_finite() && *v > 0.0);
    value.ok_or_else(|| format!("found {text:?}, expected a positive number"))
}

fn finite(text: &str) -> std::result::Result<f64, String> {
    text.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| format!("found {text:?}, expected a number"))
}

/// A positive number, or two of them as `A/B`.
fn fraction(text: &str) -> std::result::Result<f64, String> {
    match text.split_once('/') {
        None => positive(text),
        Some((above, below)) => Ok(positive(above)? / positive(below)?),
    }
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Ranges {
    /// Least mean squared error of rounding and clipping.
    Mse,
    /// Smallest and largest value seen.
    Minmax,
}

fn size(text: &str) -> std::result::Result<u64, String> {
    parse_size(text).map_err(|e| format!("{}, {}", e.message, e.help))
}

/// `NAME=BYTES`; names are judged where the regions meet.
fn region(text: &str) -> std::result::Result<Region, String> {
    let (name, bytes) = text.split_once('=').ok_or_else(|| format!("found {text:?}, expected NAME=BYTES"))?;
    Ok(Region { name: name.into(), bytes: Some(size(bytes)?) })
}

#[derive(Debug, Args)]
struct TargetArgs {
    /// Built-in target name, or a .toml file that describes one.
    #[arg(long, default_value = "portable", value_name = "NAME|FILE.toml")]
    target: String,
    /// RAM for the arena: bytes, or with K or M.
    #[arg(long, value_name = "BYTES", value_parser = size, conflicts_with = "region")]
    ram: Option<u64>,
    /// A memory for the arena, instead of the target's: name and bytes (or with K or M). Give up to four, the fastest
    /// first: the hottest buffers go there.
    #[arg(long, value_name = "NAME=BYTES", value_parser = region)]
    region: Vec<Region>,
    /// Flash for the image: bytes, or with K or M.
    #[arg(long, value_name = "BYTES", value_parser = size)]
    flash: Option<u64>,
    /// Give the output of a max pool its own memory.
    #[arg(long)]
    no_in_place_pooling: bool,
}

impl ImportArgs {
    /// The importer's options.
    ///
    /// # Errors
    /// A system that does not exist.
    pub fn options(&self) -> Result<ImportOptions> {
        let system = self.system.as_deref().map(str::parse).transpose();
        let system = system.map_err(|e: Error| e.within("--system"))?;
        let resolution = self.resolution.map(|Resolution(h, w)| (h, w));
        Ok(ImportOptions {
            system,
            heads: self.heads,
            fusion_scales: self.fusion_scales,
            resolution,
            normalization: self.normalization(),
            hack: self.hack,
            temperature: self.temperature.map(|t| t as f32),
        })
    }

    /// `(x·scale − mean)/std` in grey levels.
    fn normalization(&self) -> Option<Normalization> {
        let scale = self.scale.unwrap_or(1.0 / 255.0);
        let raw = |values: &[f64]| values.iter().map(|v| (v / scale) as f32).collect();
        Some(Normalization { mean: raw(self.mean.as_ref()?), std: raw(self.std.as_ref()?) })
    }
}

impl QuantizeArgs {
    fn options(&self) -> QuantizeOptions {
        QuantizeOptions {
            skip: self.skip.clone(),
            ranges: match self.ranges {
                Ranges::Mse => RangeRule::Mse,
                Ranges::Minmax => RangeRule::MinMax,
            },
            bias_correction: !self.no_bias_correction,
            data_aware_rounding: !self.no_data_aware_rounding,
            max_velocity: self.max_velocity,
            ..QuantizeOptions::default()
        }
    }

    fn graph(&self, path: &Path) -> Result<Graph> {
        pipeline::load_graph(path, &self.import.options()?, &PassOptions::default())
    }

    fn quantized(&self, path: &Path, bar: &mut Bar) -> Result<QModel> {
        bar.show("import", 0, 1);
        let graph = self.graph(path)?;
        let calib = self.calib.as_deref().ok_or_else(|| {
            Error::new(ErrorCode::Usage, path.display().to_string(), "this model needs calibration frames")
                .with_help("add --calib FRAMES (a frame directory or a .safetensors file of raw inputs)")
        })?;
        bar.show("load frames", 0, 1);
        let format = FrameFormat { resize: self.resize.resize, ..FrameFormat::of_graph(&graph) };
        let frames = frames::load(calib, &format)?;
        pipeline::quantize_graph(&graph, &frames, &self.options(), &mut |s, d, t| bar.show(s, d, t))
    }
}

impl TargetArgs {
    fn target(&self) -> Result<Target> {
        let mut target = Target::find(&self.target)?;
        if !self.region.is_empty() {
            target = target.with_regions(self.region.clone())?;
        }
        if self.ram.is_some() && target.regions.len() > 1 {
            let names: Vec<String> = target.regions.iter().map(|r| format!("--region {}=BYTES", r.name)).collect();
            let message = format!("target {} has {} memories, --ram is the size of one", target.name, names.len());
            return Err(Error::new(ErrorCode::Usage, "--ram", message).with_help(format!("use {}", names.join(" "))));
        }
        Ok(target.with_limits(self.ram, self.flash))
    }

    fn plan_options(&self, target: &Target) -> PlanOptions {
        PlanOptions { in_place_pooling: !self.no_in_place_pooling, ..PlanOptions::for_target(target) }
    }
}

/// Parses the arguments (the first is the program), runs the command, prints its result; returns the exit status.
pub fn main(arguments: impl IntoIterator<Item = OsString>, mut console: Console<'_>) -> u8 {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => {
            console.complain(&error.render().to_string());
            return ErrorCode::Usage.exit_status();
        }
        Err(help) => {
            console.print(&help.render().to_string());
            return 0;
        }
    };
    let mut bar = Bar::default();
    let result = cli.command.execute(&mut bar, &mut console);
    bar.finish();
    match result {
        Ok((text, status)) => {
            console.print(&text);
            status
        }
        Err(error) => {
            console.complain(&format!("error: {error}"));
            error.code.exit_status()
        }
    }
}

impl Command {
    /// Runs the command; what it has to say is for standard output, its number the exit status. Nothing half-written is
    /// left behind.
    fn execute(&self, bar: &mut Bar, console: &mut Console<'_>) -> Result<(String, u8)> {
        let done = match self {
            Self::Inspect { file, diff: Some(before), json } => return diff::run(before, file, *json),
            Self::Quantize { model, quantize, output } => run_quantize(model, quantize, output, bar),
            Self::Compile { model, quantize, target, revision, forms, output } => {
                run_compile(model, quantize, target, *revision, (forms, output), bar, console)
            }
            Self::Convert { image, forms, output } => convert::run(image, forms, output),
            Self::Inspect { file, .. } => inspect::inspect(file),
            Self::Completions(shell) => Ok(shell.script::<Cli>()),
        };
        done.map(|text| (text, 0))
    }
}

fn run_quantize(model: &Path, quantize: &QuantizeArgs, output: &Path, bar: &mut Bar) -> Result<String> {
    check_output(output, model)?;
    if is_quantized(model)? {
        let error = Error::new(ErrorCode::Usage, model.display().to_string(), "this model is quantized already");
        return Err(error.with_help("model-compiler compile makes an image of it"));
    }
    let quantized = quantize.quantized(model, bar)?;
    let bytes = artifact::to_bytes(&quantized)?;
    artifact::write_file(output, &bytes)?;
    Ok(format!("{}: {} steps, {} B", output.display(), quantized.steps.len(), bytes.len()))
}

fn run_compile(
    model: &Path,
    quantize: &QuantizeArgs,
    target: &TargetArgs,
    revision: u32,
    (forms, output): (&FormArgs, &Path),
    bar: &mut Bar,
    console: &mut Console<'_>,
) -> Result<String> {
    forms.check()?;
    let image_path = forms.image_path(output)?;
    let record = pipeline::record_path(output);
    if record == output {
        let error = Error::new(ErrorCode::Usage, output.display().to_string(), "this name is for the record");
        return Err(error.with_help("give the image another extension, such as .img"));
    }
    let beside = Some(image_path.clone()).filter(|path| path != output);
    let outputs = [forms.paths(output), vec![record], beside.into_iter().collect()].concat();
    convert::check_outputs(&outputs, model)?;
    let target_data = target.target()?;
    let quantized = if is_quantized(model)? {
        if quantize.calib.is_some() {
            console.complain(&format!("warning: {} is quantized already; --calib has no effect", model.display()));
        }
        artifact::read::<QModel>(model)?
    } else {
        quantize.quantized(model, bar)?
    };
    let options = target.plan_options(&target_data);
    let compiled = pipeline::compile(&quantized, &target_data, &options, &mut |s, d, t| bar.show(s, d, t));
    let compiled = compiled.and_then(|c| c.with_revision(revision)).map_err(|e| e.within(model.display()))?;
    let files = forms.files(&compiled.image, output)?;
    let others = files.iter().map(|(path, bytes)| (path.as_path(), bytes.as_slice()));
    let others: Vec<_> = others.filter(|(path, _)| *path != image_path).collect();
    pipeline::write_with(&compiled, &image_path, &others)?;
    let mut text = String::new();
    for (key, value) in pipeline::summary(&compiled) {
        let _ = writeln!(text, "{key:>8}  {value}");
    }
    let _ = writeln!(text, "{:>8}  {}", "written", output.display());
    Ok(text)
}

/// Before minutes of work: whether the output can be written where it shall go, and is not the input.
fn check_output(output: &Path, input: &Path) -> Result<()> {
    let refuse = |code, path: &Path, message: &str, help: &str| {
        Err(Error::new(code, path.display().to_string(), message).with_help(help))
    };
    let folder = artifact::folder_of(output);
    if !folder.is_dir() {
        return refuse(ErrorCode::Io, output, &format!("there is no folder {}", folder.display()), "create it first");
    }
    if output.is_dir() {
        return refuse(ErrorCode::Io, output, "this is a folder, expected the name of a file", "add a file name");
    }
    let same = output.canonicalize().is_ok_and(|o| input.canonicalize().is_ok_and(|i| o == i));
    if same {
        return refuse(ErrorCode::Usage, output, "the output would replace the input", "give it another name");
    }
    Ok(())
}

fn is_quantized(path: &Path) -> Result<bool> {
    use std::io::Read;
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| Error::io(path, &e))?;
    file.take(8).read_to_end(&mut head).map_err(|e| Error::io(path, &e))?;
    Ok(artifact::is::<QModel>(&head))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_has_examples_and_they_parse() {
        let program = Cli::command();
        for command in std::iter::once(&program).chain(program.get_subcommands()) {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let examples: Vec<&str> = help.lines().filter_map(|line| line.strip_prefix("  ")).collect();
            assert!(!examples.is_empty(), "{} has no examples", command.get_name());
            for example in examples {
                let words: Vec<&str> = example.split_whitespace().collect();
                Cli::try_parse_from(&words).unwrap_or_else(|e| panic!("{example}: {e}"));
                assert!(command.get_name() == "model-compiler" || words[1] == command.get_name(), "{example}");
            }
        }
    }
}
