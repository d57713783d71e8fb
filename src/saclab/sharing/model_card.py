"""The model card: README.md, with the metadata by which the Hugging Face Hub finds and shows a policy."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from saclab.hub import library
from saclab.playback import EvaluationResult
from saclab.report.text import count_text, number_text
from saclab.report.train_command import train_command
from saclab.training.run_folder import RunRecord
from saclab.variants import VARIANTS

VIDEO = "replay.mp4"
"""The name under which the Hub shows the film of a reinforcement learner."""


class Card(NamedTuple):
    """What is told of a policy."""

    repository: str
    """user/name."""
    run: RunRecord
    result: EvaluationResult
    """Of the policy, on fresh episodes of the mean action."""
    seed: int
    """Of those episodes."""
    imports: Sequence[str]
    """Packages that the environment needs."""
    license: str | None
    """An identifier of the Hub's, such as mit."""

    def text(self, files: Iterable[str]) -> str:
        """README.md of a repository that holds these files."""
        sections = [
            f"# {self.title} on {self.result.environment}",
            self.origin(),
            *([f"[Film of an episode]({VIDEO})"] if VIDEO in files else []),
            "## Score",
            self.score(),
            self.choice(),
            "## Use",
            self.use(),
            "## Training",
            self.training(),
        ]
        return f"---\n{self.metadata().to_yaml().strip()}\n---\n\n" + "\n\n".join(sections) + "\n"

    @property
    def title(self) -> str:
        name = self.run.config.variant
        return VARIANTS[name].title if name in VARIANTS else name

    @property
    def task(self) -> str:
        """The environment's id without the package that registers it."""
        return self.result.environment.rpartition(":")[2]

    def metadata(self) -> Any:
        """huggingface_hub's ModelCardData; one result, as reinforcement learners have it on the Hub."""
        hub, result = library(), self.result
        score = hub.EvalResult(
            task_type="reinforcement-learning",
            task_name="reinforcement-learning",
            dataset_type=self.task,
            dataset_name=self.task,
            metric_type="mean_reward",
            metric_name="mean_reward",
            metric_value=f"{result.mean_return:.2f} +/- {result.standard_deviation:.2f}",
            metric_args={"episodes": result.episodes, "seed": self.seed, "deterministic": True, "training_runs": 1},
        )
        tags = [self.task, "deep-reinforcement-learning", "reinforcement-learning", "soft-actor-critic",
                self.run.config.variant, "continuous-control", "jax", "saclab"]  # fmt: skip
        return hub.ModelCardData(
            library_name="saclab",
            pipeline_tag="reinforcement-learning",
            license=self.license,
            tags=tags,
            model_name=self.repository.partition("/")[2],
            eval_results=[score],
        )

    def origin(self) -> str:
        config, version = self.run.config, self.run.versions.get("saclab", "of unknown version")
        description = f": {VARIANTS[config.variant].description.rstrip('.')}" if config.variant in VARIANTS else ""
        return (
            f"A policy for `{config.environment}`, trained with saclab {version}, a laboratory for Soft Actor-Critic. "
            f"Variant `{config.variant}`{description}. Protocol `{config.protocol}`, seed {config.seed}."
        )

    def score(self) -> str:
        result = self.result
        spread = f"{number_text(result.mean_return)} ± {number_text(result.standard_deviation)}"
        low, high = (number_text(end(result.total_rewards)) for end in (min, max))
        return (
            f"Return **{spread}** (mean ± standard deviation, from {low} to {high}) over "
            f"{count_text(result.episodes, 'fresh episode')} of the mean action, begun from seed {self.seed}: neither "
            "the training nor the choice of the policy saw them. The ± is the spread of its episodes. It is **one** "
            "training run: how far another seed's would end from it cannot be told from this."
        )

    def choice(self) -> str:
        """How the policy was chosen: the best of so many noisy evaluations."""
        evaluations, result = self.run.evaluations, self.run.result
        means = evaluations["mean_return"]
        best = int(means.argmax())
        ended = (
            f"The run ended after {result['steps']:,} steps and {result['updates']:,} updates."
            if result is not None
            else "**The run had not finished** when this was shared."
        )
        return (
            f"It is the policy of the best of {count_text(len(means), 'evaluation')} in training, each of "
            f"{count_text(evaluations['returns'].shape[1], 'episode')}: number {best + 1}, at step "
            f"{int(evaluations['steps'][best]):,}, had a mean return of {number_text(means[best])} (a maximum over "
            f"noisy numbers, which flatters); the last one had {number_text(means[-1])}. {ended}"
        )

    def use(self) -> str:
        words = ["saclab", "evaluate", f"hf:{self.repository}"]
        words += ["--episodes", str(self.result.episodes), "--seed", str(self.seed)]
        if self.imports:
            words += ["--imports", *self.imports]
        return (
            "With saclab and its extra `hub` installed:\n\n"
            f"```bash\n{shlex.join(words)}\n```\n\n"
            f'```python\nimport saclab\n\npolicy = saclab.load_policy("hf:{self.repository}")\n'
            "action, _ = policy.predict(observation)   # within the environment's bounds; NumPy only\n```\n\n"
            "saclab fetches policy.safetensors and policy.json, arrays and text: nothing of this repository is run."
        )

    def training(self) -> str:
        versions = ", ".join(f"{name} {version}" for name, version in self.run.versions.items())
        return f"```bash\n{train_command(self.run.config)}\n```\n\n{versions}."
