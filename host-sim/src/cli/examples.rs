//! What `--help` shows at its end. A line that begins with two blanks is a command that works as it stands.

pub const ALL: &str =
    "Without a command: the demo. It compiles the bundled network (small and untrained), runs it, verifies every
byte, and writes image, record and report.

Examples:
  host-sim
  host-sim run transfuser.img --frames frames/
  host-sim verify transfuser.img --model transfuser.pth --frames drive/ --mirror --min-sqnr 20
  host-sim bench transfuser.img
  host-sim ablate transfuser.pth --calib frames/ --frames drive/
  host-sim attention transfuser.img --model transfuser.pth --frames drive/
  host-sim drive transfuser.img --log drive/
  host-sim hil transfuser.img --board an386 --frames frames/
  host-sim score route-1.json route-2.json
  host-sim footprint firmware.elf
  host-sim completions bash";

pub const RUN: &str = "Examples:
  host-sim run transfuser.img --frames frames/
  host-sim run transfuser.img --frames frames/ --backend portable
  host-sim run transfuser.pth --inputs inputs.safetensors --json";

pub const VERIFY: &str = "Examples:
  host-sim verify transfuser.img --inputs inputs.safetensors
  host-sim verify transfuser.img --model transfuser.pth --frames drive/
  host-sim verify transfuser.img --model transfuser.pth --frames drive/ --mirror --min-sqnr 20
  host-sim verify transfuser.img --record build/transfuser.record --frames drive/ --json
  host-sim verify transfuser.img --model transfuser.pth --frames frames/ --report out/ --gate gates.toml
  host-sim verify resnet20.img --model resnet20.onnx --frames images/ --min-agreement 98";

pub const DIFF: &str = "Examples:
  host-sim diff old/report.json new/report.json
  host-sim diff old/report.json new/report.json --max-loss 1 --report out/";

pub const SCHEMA: &str = "Examples:
  host-sim schema
  host-sim schema run
  host-sim schema attention
  host-sim schema hil
  host-sim schema route-log";

pub const ABLATE: &str = "Examples:
  host-sim ablate transfuser.pth --calib frames/ --frames drive/
  host-sim ablate transfuser.pth --calib inputs.safetensors --inputs inputs.safetensors --mirror --json";

pub const ATTENTION: &str = "Examples:
  host-sim attention transfuser.img --model transfuser.pth --frames drive/
  host-sim attention transfuser.img --model transfuser.pth --frames drive/ --report out/
  host-sim attention transfuser.img --frames drive/ --block encoder.transformer2
  host-sim attention transfuser.pth --frames drive/ --image-rows 3,4 --lidar-rows 5,6,7 --top 3 --json";

pub const DRIVE: &str = "Examples:
  host-sim drive transfuser.img --log drive/
  host-sim drive transfuser.img --log drive/ --model transfuser.pth --report out/
  host-sim drive transfuser.img --log drive/ --json";

pub const UPDATE: &str = "Examples:
  host-sim update new.img --port /dev/ttyACM0 --baud 1000000
  host-sim update new.img --board an386 --running old.img";

pub const HIL: &str = "Examples:
  host-sim hil transfuser.img --board an386 --frames frames/
  host-sim hil transfuser.img --board an547 --frames frames/ --steps --json
  host-sim hil transfuser.img --board virt --inputs inputs.safetensors
  host-sim hil transfuser.img --board an500 --log drive/
  host-sim hil transfuser.img --port /dev/ttyACM0 --baud 1000000 --frames frames/ --crop
  host-sim hil transfuser.img --port /dev/ttyACM0 --log drive/ --budget-ms 50 --silence-ms 200 --background";

pub const SCORE: &str = "Examples:
  host-sim score route-1.json route-2.json
  host-sim score route-1.json --json";

pub const BENCH: &str = "Examples:
  host-sim bench transfuser.img
  host-sim bench transfuser.img --backend portable --backend avx2 --rounds 50
  host-sim bench transfuser.img --all
  host-sim bench transfuser.img --json";

pub const FOOTPRINT: &str = "Examples:
  host-sim footprint target/mcu/thumbv7em-none-eabihf/release/an386-drive
  host-sim footprint an386-check --stack measure::step --stack measure::parse
  host-sim footprint an386-drive an547-drive virt-drive --json";

pub const COMPLETIONS: &str = "In bash: `source <(host-sim completions bash)`, now or in ~/.bashrc.

Examples:
  host-sim completions bash
  host-sim completions zsh";
