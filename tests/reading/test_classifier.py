"""The net and its training data: what is in an example, what comes out of training, what can be transformed."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.experiment.signals import bin_average, words
from gmem_jax.reading import classify
from gmem_jax.reading.training import QUICK_CHECK, STEPS_PER_CALL

SMALL = classify.TrainingConfig(2, hidden=(32, 32))
PAPER = classify.TrainingConfig(3)
MAKE = jax.jit(lambda data, word, combination: data.make(word, combination))


@pytest.fixture(scope="module")
def small() -> classify.Training:
    return classify.train(SMALL, 0)


@pytest.fixture(scope="module")
def data() -> classify.Examples:
    return classify.examples(PAPER, 0)


def test_the_library_shows_the_module_as_classify() -> None:
    assert gm.classify is classify


def test_the_net_is_the_papers(data: classify.Examples) -> None:
    net = classify.initial(PAPER, 0)
    shapes = [layer["kernel"].shape for _, layer in sorted(net.parameters.items())]
    assert shapes == [(256, 1024), (1024, 1024), (1024, 8)]
    assert {leaf.dtype for leaf in jax.tree.leaves(net.parameters)} == {jnp.dtype("float32")}
    for _, layer in sorted(net.parameters.items()):
        bound = np.sqrt(6.0 / layer["kernel"].shape[0])  # Kaiming-uniform
        largest = float(np.abs(layer["kernel"]).max())
        assert 0.99 * bound < largest <= bound * (1.0 + 1e-6)
        # A uniform distribution's SD, known to 1 / sqrt(2 n) of itself with n = 8,192 weights at least.
        assert float(np.std(layer["kernel"])) == pytest.approx(bound / np.sqrt(3.0), rel=0.03)
        assert not np.any(layer["bias"])
    assert PAPER.combinations == 17_325
    assert data.table.shape == (8, 21, 256)


def test_an_example_is_a_shifted_scaled_word_plus_noise_of_its_rung(data: classify.Examples) -> None:
    mean = float(jnp.mean(jnp.abs(bin_average(words(3)))))
    u_b, word = 1.0 / 7.0, 5
    for shift, factor, draw in ((0, 0, 0), (20, 32, 24), (10, 16, 12), (3, 30, 6)):
        moved = replace(words(3), centres=words(3).centres + u_b * 0.3 * (shift / 10.0 - 1.0))
        clean = np.asarray(bin_average(moved))[word] / mean * (1.0 + 0.3 * (factor / 16.0 - 1.0))
        made = np.asarray(MAKE(data, jnp.asarray(word), jnp.asarray((shift * 33 + factor) * 25 + draw)))
        assert made.dtype == np.float32
        made = made * float(data.level[shift, factor, draw])
        deviation = 0.3 * draw / 24.0
        # The SD of 256 draws is known to 1 / sqrt(512) of itself; four of these. Float32 leaves 1e-6 where it is 0.
        assert np.std(made - clean) == pytest.approx(deviation, rel=4.0 / np.sqrt(512.0), abs=1e-6)
        assert abs(np.mean(made - clean)) < 4.0 * deviation / 16.0 + 1e-6


def test_every_set_is_as_large_as_every_other() -> None:
    bits = 7  # 128 words: |J| of a set with its noise is known to 1 / sqrt(128 * 256)
    data = classify.examples(classify.TrainingConfig(bits), 3)
    for shift, factor, draw in ((0, 0, 0), (20, 32, 24), (10, 0, 24), (3, 30, 6)):
        made = np.asarray(MAKE(data, jnp.arange(1 << bits), jnp.asarray((shift * 33 + factor) * 25 + draw)))
        assert np.mean(np.abs(made)) == pytest.approx(1.0, rel=1e-4 if draw == 0 else 4.0 / np.sqrt(128 * 256))
    assert float(data.level[10, 0, 24]) > 1.1 * 0.7  # noise of 0.43 of what it is added to


def test_examples_follow_from_their_numbers_and_the_seed_alone(data: classify.Examples) -> None:
    word, combination = jnp.asarray([3, 3, 4]), jnp.asarray([24, 49, 24])
    together = np.asarray(MAKE(data, word, combination))
    alone = np.asarray(MAKE(data, word[2:], combination[2:]))
    np.testing.assert_array_equal(together[2:], alone)
    level = np.asarray(data.level[0, [0, 1, 0], 24])[:, None]
    noise = together - np.asarray(data.table[word, 0]) * np.array([0.7, 0.7 + 0.6 / 32.0, 0.7])[:, None] / level
    assert np.abs(np.corrcoef(noise)[np.triu_indices(3, 1)]).max() < 0.3  # independent: SD 1 / 16
    other = MAKE(classify.examples(PAPER, 1), word, combination)
    assert np.abs(np.asarray(other) - together).max() > 0.1


def test_held_out_combinations_are_never_trained_on(data: classify.Examples) -> None:
    kept = set(np.asarray(data.order[: PAPER.kept]).tolist())
    trained = set(np.asarray(data.order[PAPER.kept :]).tolist())
    assert len(kept) == 1_732
    assert len(trained) == 17_325 - 1_732
    assert not kept & trained

    class Spy(classify.Examples):
        def make(self, word: jax.Array, combination: jax.Array) -> jax.Array:
            return combination

    spy = Spy(data.table, data.level, data.order, data.noise, data.lessons)
    for key in range(50):
        asked, word = spy.training(jax.random.key(key))
        assert set(np.asarray(asked).tolist()) <= trained
        assert np.asarray(word).max() < 8
    numbers = jnp.arange(8 * PAPER.kept)
    asked, word = spy.held_out(numbers)
    pairs = set(zip(np.asarray(word).tolist(), np.asarray(asked).tolist(), strict=True))
    assert len(pairs) == len(numbers)  # each once
    assert {combination for _, combination in pairs} == kept
    few = np.asarray(spy.held_out(numbers[:QUICK_CHECK])[0])
    assert len(set(few.tolist())) > 500  # a quick check covers many combinations


def test_no_two_examples_have_the_same_noise() -> None:
    recipe = classify.TrainingConfig(2, shifts=2, amplitudes=3, draws=3)
    data = classify.examples(recipe, 0)
    word, combination = (part.ravel() for part in jnp.meshgrid(jnp.arange(4), jnp.arange(18), indexing="ij"))
    shift, factor, draw = combination // 9, combination // 3 % 3, combination % 3
    level = np.asarray(data.level[shift, factor, draw])[:, None]
    clean = np.asarray(data.table[word, shift]) * (0.7 + 0.3 * np.asarray(factor))[:, None] / level
    noise = (np.asarray(MAKE(data, word, combination)) - clean)[np.asarray(draw) > 0]  # the first draw has none
    correlation = np.corrcoef(noise)[np.triu_indices(len(noise), 1)]
    assert len(noise) == 48
    assert np.abs(correlation).max() < 0.4  # 1,128 pairs with an SD of 1 / 16; the same noise has 1


def test_a_quick_check_takes_other_combinations_for_every_word(data: classify.Examples) -> None:
    class Spy(classify.Examples):
        def make(self, word: jax.Array, combination: jax.Array) -> jax.Array:
            return combination

    asked, word = Spy(data.table, data.level, data.order, data.noise, data.lessons).held_out(jnp.arange(QUICK_CHECK))
    assert np.bincount(np.asarray(word)).tolist() == [QUICK_CHECK // 8] * 8
    assert len(set(np.asarray(asked[:8]).tolist())) == 8
    # 512 for every word; each word begins 7 further than the one before.
    assert len(set(np.asarray(asked).tolist())) == 512 + 7 * 7


def test_which_combinations_are_held_out_depends_on_the_seed(data: classify.Examples) -> None:
    other = classify.examples(PAPER, 1)
    same = np.intersect1d(data.order[: PAPER.kept], other.order[: PAPER.kept])
    assert len(same) < 300  # by chance 173


def test_the_papers_net_learns_three_bits(tmp_path: Path) -> None:
    """The real one: 256-1024-1024-8 on inputs only, stopped by its own rule."""
    trained = classify.train(PAPER, 0, budget=110.0)
    assert trained.finished
    assert trained.examples == 8 * PAPER.kept
    assert trained.validation > 0.999
    assert trained.seconds < 120.0
    clean = bin_average(words(3))
    assert float(classify.accuracy(trained.net, 1e-7 * clean)) == 1.0
    stretched = clean * jnp.linspace(0.8, 1.2, 256)  # none of the transformations it was trained on
    assert float(classify.accuracy(trained.net, stretched)) == 1.0


def test_training_is_reproducible_and_depends_on_the_seed(small: classify.Training) -> None:
    again, other = classify.train(SMALL, 0), classify.train(SMALL, 1)
    assert again.step == small.step
    for one, two in zip(jax.tree.leaves(small.net), jax.tree.leaves(again.net), strict=True):
        np.testing.assert_array_equal(one, two)
    first, second = (jax.tree.leaves(training.net)[1] for training in (small, other))
    assert np.abs(np.asarray(first) - np.asarray(second)).max() > 0.1


@pytest.mark.parametrize("interrupted", [False, True])
def test_broken_off_training_goes_on_to_the_same_net(tmp_path: Path, interrupted: bool) -> None:
    def interrupt(_: classify.Training) -> None:
        raise KeyboardInterrupt

    file = tmp_path / "net.msgpack"
    limit = 3 * STEPS_PER_CALL
    through = classify.train(SMALL, 3, target=1.1, most_steps=limit)
    if interrupted:
        with pytest.raises(KeyboardInterrupt):
            classify.train(SMALL, 3, target=1.1, checkpoint=file, listener=interrupt)
        broken = classify.load(file)
    else:
        broken = classify.train(SMALL, 3, target=1.1, budget=0.0, checkpoint=file)  # one call, then out of time
    assert (broken.step, broken.finished) == (STEPS_PER_CALL, False)
    resumed = classify.train(SMALL, 3, target=1.1, most_steps=limit, checkpoint=file)
    assert resumed.step == through.step == limit
    assert resumed.seconds > broken.seconds
    for one, two in zip(jax.tree.leaves(through.net), jax.tree.leaves(resumed.net), strict=True):
        np.testing.assert_array_equal(one, two)
    assert [path.name for path in tmp_path.iterdir()] == ["net.msgpack"]  # nothing temporary left


def test_a_finished_net_is_loaded_not_trained(small: classify.Training, tmp_path: Path) -> None:
    file = tmp_path / "net.msgpack"
    classify.save(file, small)
    calls: list[classify.Training] = []
    again = classify.train(SMALL, 0, checkpoint=file, listener=calls.append)
    assert calls == []
    assert again.net.lessons == SMALL
    assert (again.step, again.validation, again.seconds) == (small.step, small.validation, small.seconds)
    signals = np.random.default_rng(7).normal(size=(4, 256))
    np.testing.assert_array_equal(classify.logits(again.net, signals), classify.logits(small.net, signals))


def test_a_net_of_any_whole_numbers_can_be_read_again(tmp_path: Path) -> None:
    config = classify.TrainingConfig(np.int64(2), hidden=[8])  # type: ignore[arg-type]
    trained = classify.train(config, np.int64(3), budget=60.0, most_steps=5, checkpoint=tmp_path / "net.msgpack")  # type: ignore[arg-type]
    assert classify.load(tmp_path / "net.msgpack").net.lessons == trained.net.lessons


def test_the_listener_is_told_loss_and_held_out_accuracy() -> None:
    seen: list[classify.Training] = []
    classify.train(SMALL, 0, target=1.1, most_steps=500, listener=seen.append)
    assert [training.step for training in seen] == [250, 500]
    assert 0.0 < seen[1].loss < seen[0].loss < np.log(4.0)
    assert all(0.0 < training.validation <= 1.0 for training in seen)


def test_a_net_of_other_words_or_another_seed_is_not_mistaken(small: classify.Training, tmp_path: Path) -> None:
    file = tmp_path / "net.msgpack"
    classify.save(file, small)
    for lessons, seed in ((SMALL, 1), (replace(SMALL, bits=3), 0), (replace(SMALL, noise=0.2), 0)):
        with pytest.raises(ValueError, match="holds the net of seed 0"):
            classify.train(lessons, seed, checkpoint=file)


def test_broken_and_foreign_files_are_refused(small: classify.Training, tmp_path: Path) -> None:
    file = tmp_path / "net.msgpack"
    with pytest.raises(FileNotFoundError, match="no such file"):
        classify.load(file)
    classify.save(file, small)
    whole = file.read_bytes()
    for content, words_said in (
        (whole[:5000], "its checksum does not fit"),
        (b"", "not a readable"),
        (b"\x01", "it has no checksum"),
    ):
        file.write_bytes(content)
        with pytest.raises(gm.FileFormatError, match=words_said):
            classify.load(file)


def test_the_scale_of_a_recalled_set_does_not_matter(small: classify.Training) -> None:
    signals = np.random.default_rng(7).normal(size=(4, 256))
    # Single precision rounds the normalised inputs differently.
    np.testing.assert_allclose(
        classify.logits(small.net, 1e-8 * signals), classify.logits(small.net, signals), rtol=1e-4, atol=1e-4
    )
    assert float(jnp.mean(jnp.abs(classify.normalise(jnp.asarray(1e-8 * signals))))) == pytest.approx(1.0, rel=1e-6)


def test_other_words_can_be_asked_for(small: classify.Training) -> None:
    signals = bin_average(words(2))
    order = jnp.asarray([2, 0, 3, 1])
    assert float(classify.accuracy(small.net, signals)) == 1.0
    assert float(classify.accuracy(small.net, signals[order])) == 0.0
    assert float(classify.accuracy(small.net, signals[order], order)) == 1.0
    assert float(classify.cross_entropy(small.net, signals[order], order)) < 0.1
    assert float(classify.cross_entropy(small.net, signals[order])) > 1.0
    with pytest.raises(ValueError, match="8 signals, and the net knows 4 words: name the word of each"):
        classify.accuracy(small.net, jnp.concatenate([signals, signals]))


def test_nothing_is_read_from_a_broken_run(small: classify.Training) -> None:
    broken = bin_average(words(2)).at[1].set(jnp.nan)
    for signals in (broken, jnp.zeros((4, 256))):
        assert np.isnan(float(classify.accuracy(small.net, signals)))
        assert classify.predict(small.net, signals).tolist() == [-1] * 4  # a set is read as a whole


def test_jit_changes_nothing(small: classify.Training) -> None:
    signals = jnp.asarray(np.random.default_rng(7).normal(size=(4, 256)))
    for function in (classify.accuracy, classify.cross_entropy):
        plain, compiled = function(small.net, signals), jax.jit(function)(small.net, signals)
        np.testing.assert_allclose(compiled, plain, rtol=1e-5)  # float32, other order of sums


@pytest.mark.slow
def test_training_can_be_mapped_over_seeds() -> None:
    def learn(seed: jax.Array) -> tuple[classify.Net, jax.Array, jax.Array]:
        data = classify.examples(SMALL, seed)
        net, loss = classify.learn(classify.initial(SMALL, seed), data, seed, 0, 60)
        return net, loss, classify.validate(net, data, 512)

    nets, losses, validation = jax.jit(jax.vmap(learn))(jnp.arange(3))
    assert losses.shape == validation.shape == (3,)
    assert len(set(np.asarray(losses).tolist())) == 3
    for seed in (0, 2):
        one, loss, accuracy = jax.jit(learn)(jnp.asarray(seed))
        # Float32 over 60 steps of other orders of sums; the losses of two seeds differ by far more.
        assert float(losses[seed]) == pytest.approx(float(loss), rel=1e-3)
        assert abs(float(validation[seed]) - float(accuracy)) < 5.0 / 512.0
        for many, single in zip(jax.tree.leaves(nets), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(many[seed], single, atol=1e-3)


def test_the_gradient_of_the_cross_entropy_reaches_the_recalled_signal(small: classify.Training) -> None:
    signals = 3e-7 * (bin_average(words(2)) + 0.02 * np.random.default_rng(7).normal(size=(4, 256)))
    wanted = jnp.asarray([1, 0, 3, 2])  # wrong ones: a loss of several nats, which is nearly straight

    def loss(x: jax.Array) -> jax.Array:
        return classify.cross_entropy(small.net, x, wanted)

    slope = jax.jit(jax.grad(loss))(signals)
    assert slope.dtype == signals.dtype == jnp.float64
    assert np.all(np.isfinite(slope))
    # Scaling the whole set changes nothing: the slope along the set itself vanishes, up to float32.
    unit = slope / jnp.linalg.norm(slope)
    assert abs(float(jnp.sum(unit * signals))) < 1e-4 * float(jnp.linalg.norm(signals))
    # A step of 0.2 % of the set changes the loss by some 0.1, of which float32 losses of order 10 know 1e-5; units of a
    # ReLU net that switch within the step add up to some per mille.
    step = 0.002 * float(jnp.linalg.norm(signals)) * unit
    rise = loss(signals + step) - loss(signals - step)
    assert float(rise) == pytest.approx(2.0 * float(jnp.sum(slope * step)), rel=0.01)
