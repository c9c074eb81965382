//! Commands: `quantize`, `compile`, `inspect`.

use crate::artifact;
use crate::error::{Error, ErrorCode, Result};
use crate::import::ImportOptions;
use crate::ir::Graph;
use crate::memory_plan::PlanOptions;
use crate::passes::PassOptions;
use crate::pipeline;
use crate::qmodel::QModel;
use crate::quantize::{QuantizeOptions, RangeRule, SkipStages};
use crate::target::{Target, parse_size};
use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

mod inspect;

/// Trained driving networks to int8 model images.
#[derive(Debug, Parser)]
#[command(version, about, after_help = EXAMPLES)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "Examples:
  model-compiler compile transfuser.pth --calib frames/ --target cortex-m7 -o transfuser.img
  model-compiler quantize transfuser.pth --calib inputs.safetensors --skip i16 -o transfuser.qmodel
  model-compiler compile transfuser.qmodel --ram 1536K --flash 128M -o transfuser.img
  model-compiler inspect transfuser.img";

#[derive(Debug, Subcommand)]
enum Command {
    /// Checkpoint to quantized model (.qmodel): integers, scales and tables, independent of any target.
    Quantize {
        /// Checkpoint (.pth, .pt, .th, .safetensors).
        model: PathBuf,
        #[command(flatten)]
        quantize: QuantizeArgs,
        /// Output file.
        #[arg(short, long, value_name = "FILE.qmodel")]
        output: PathBuf,
    },
    /// Quantized model or checkpoint to model image (OUT.img) and build record (OUT.record).
    Compile {
        /// Quantized model (.qmodel) or checkpoint.
        model: PathBuf,
        #[command(flatten)]
        quantize: QuantizeArgs,
        #[command(flatten)]
        target: TargetArgs,
        /// Output file; the record gets the same name with the extension .record.
        #[arg(short, long, value_name = "OUT.img")]
        output: PathBuf,
    },
    /// What is in a file: image, quantized model or checkpoint.
    Inspect {
        /// The file.
        file: PathBuf,
    },
}

#[derive(Debug, Args)]
struct QuantizeArgs {
    /// Calibration frames: a frame directory or a .safetensors file of raw inputs.
    #[arg(long, value_name = "FRAMES|FILE")]
    calib: Option<PathBuf>,
    #[command(flatten)]
    import: ImportArgs,
    /// Skip values of the ResNets: i8, i16, or a list of 16-bit stages (0 is the stem).
    #[arg(long, default_value = "i8", value_name = "i8|i16|LIST")]
    skip: SkipStages,
    /// Clipping ranges of the i8 activations.
    #[arg(long, value_enum, default_value = "mse")]
    ranges: Ranges,
    /// Leave biases as they are.
    #[arg(long)]
    no_bias_correction: bool,
    /// Fastest velocity to be driven, m/s: the token streams leave room for it.
    #[arg(long, default_value_t = 10.0, value_name = "M/S")]
    max_velocity: f64,
}

/// How a checkpoint is read where its tensors cannot tell.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// System; detected from the tensor names unless given.
    #[arg(long, value_name = "SYSTEM")]
    system: Option<String>,
    /// Attention heads (no tensor tells).
    #[arg(long, default_value_t = 4)]
    heads: u16,
    /// Height and width of the network's image and BEV inputs; told from the tensors where they tell it, else 256x256.
    #[arg(long, value_name = "HxW")]
    resolution: Option<Resolution>,
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

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Ranges {
    /// Least mean squared error of rounding and clipping.
    Mse,
    /// Smallest and largest value seen.
    Minmax,
}

#[derive(Debug, Args)]
struct TargetArgs {
    /// Built-in target name, or a .toml file that describes one.
    #[arg(long, default_value = "portable", value_name = "NAME|FILE.toml")]
    target: String,
    /// RAM for the arena: bytes, or with K or M.
    #[arg(long, value_name = "BYTES")]
    ram: Option<String>,
    /// Flash for the image: bytes, or with K or M.
    #[arg(long, value_name = "BYTES")]
    flash: Option<String>,
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
        let system = self.system.as_deref().map(str::parse).transpose()?;
        Ok(ImportOptions { system, heads: self.heads, resolution: self.resolution.map(|Resolution(h, w)| (h, w)) })
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
            max_velocity: self.max_velocity,
            ..QuantizeOptions::default()
        }
    }

    fn graph(&self, path: &Path) -> Result<Graph> {
        pipeline::load_graph(path, &self.import.options()?, &PassOptions::default())
    }

    fn quantized(&self, path: &Path, bar: &mut Bar) -> Result<QModel> {
        let graph = self.graph(path)?;
        let calib = self.calib.as_deref().ok_or_else(|| {
            Error::new(ErrorCode::Usage, path.display().to_string(), "a checkpoint needs calibration frames")
                .with_help("add --calib FRAMES (a frame directory or a .safetensors file of raw inputs)")
        })?;
        let frames = pipeline::load_frames(&graph, calib)?;
        pipeline::quantize_graph(&graph, &frames, &self.options(), &mut |s, d, t| bar.show(s, d, t))
    }
}

impl TargetArgs {
    fn target(&self) -> Result<Target> {
        let size = |text: &Option<String>| text.as_deref().map(parse_size).transpose();
        Ok(Target::find(&self.target)?.with_limits(size(&self.ram)?, size(&self.flash)?))
    }
}

impl Cli {
    /// Runs the command.
    ///
    /// # Errors
    /// Whatever stopped it; nothing half-written is left behind.
    pub fn run(self) -> Result<()> {
        let mut bar = Bar::new();
        match self.command {
            Command::Quantize { model, quantize, output } => {
                let quantized = quantize.quantized(&model, &mut bar)?;
                let bytes = artifact::to_bytes(&quantized)?;
                artifact::write_file(&output, &bytes)?;
                bar.finish();
                println!("{}: {} steps, {} B", output.display(), quantized.steps.len(), bytes.len());
            }
            Command::Compile { model, quantize, target, output } => {
                let target_data = target.target()?;
                let quantized = if is_quantized(&model)? {
                    artifact::read::<QModel>(&model)?
                } else {
                    quantize.quantized(&model, &mut bar)?
                };
                let options = PlanOptions { in_place_pooling: !target.no_in_place_pooling, ..PlanOptions::default() };
                let compiled = pipeline::compile(&quantized, &target_data, &options, &mut |s, d, t| bar.show(s, d, t))?;
                pipeline::write(&compiled, &output)?;
                bar.finish();
                for (key, value) in pipeline::summary(&compiled) {
                    println!("{key:>8}  {value}");
                }
                println!("{:>8}  {}", "written", output.display());
            }
            Command::Inspect { file } => inspect::inspect(&file)?,
        }
        Ok(())
    }
}

fn is_quantized(path: &Path) -> Result<bool> {
    use std::io::Read;
    let mut head = [0; 8];
    let mut file = std::fs::File::open(path).map_err(|e| Error::io(path, &e))?;
    let count = file.read(&mut head).map_err(|e| Error::io(path, &e))?;
    Ok(artifact::is::<QModel>(&head[..count]))
}

/// A progress bar on standard error, drawn only on a terminal.
struct Bar(ProgressBar);

impl Bar {
    fn new() -> Self {
        let bar = ProgressBar::new(1);
        if let Ok(style) = ProgressStyle::with_template("{msg:>10} [{bar:40}] {pos}/{len} {elapsed}") {
            bar.set_style(style);
        }
        Self(bar)
    }

    fn show(&mut self, stage: &str, done: usize, total: usize) {
        self.0.set_length(total as u64);
        self.0.set_position(done as u64);
        self.0.set_message(stage.to_owned());
    }

    fn finish(&self) {
        self.0.finish_and_clear();
    }
}
