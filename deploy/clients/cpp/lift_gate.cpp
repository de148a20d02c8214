// Asks graspd whether a hand may lift, prints the answer, and exits with 0 if it may, 1 if not. Or
// reports how the lift ended, and exits with 0 if graspd accepted that, 1 if not.
//
//     lift_gate [--supervised] [--still MS] ENDPOINT DEADLINE_S [ASK_ENDPOINT [OBJECT]]
//                                                     one question; a person watches the lift; the
//                                                     hand must have been still for MS. With
//                                                     OBJECT: after a yes reads held, slipped or
//                                                     not-lifted, and tells it; not-lifted at the
//                                                     end of the input. Without it the lift stays
//                                                     announced, and cannot be told
//     lift_gate --tell ENDPOINT ASK_ENDPOINT BOOT_ID GRASP held|slipped [OBJECT]
//                                                     shows the answer to a client that never got a
//                                                     yes: `not yours`. A controller tells by the
//                                                     client that asked (`tell` below)
//     lift_gate --watch ENDPOINT [SERVER.key OWN.key_secret]
//                                                     each change of the verdict, until it is killed
#include "graspd_client.hpp"

#include <iostream>
#include <sstream>

namespace {

// Returns the number that a word is; throws `std::invalid_argument` if it is anything else.
template <typename Number>
Number number(const std::string& word) {
    std::istringstream text(word);
    Number found{};
    if (!(text >> found) || text.peek() != std::char_traits<char>::eof())
        throw std::invalid_argument(word + " is not a number, such as 1 or 0.5");
    return found;
}

void print(const graspd::Verdict& verdict, const graspd::Counts& counts) {
    std::cout << graspd::name(verdict.decision) << " [";
    for (const std::string& reason : verdict.reasons) std::cout << ' ' << reason;
    std::cout << " ] grasp " << verdict.grasp.value_or(0) << " boot " << verdict.boot_id << " lost "
              << counts.lost << std::endl;
}

int watch(const graspd::Options& options) {
    graspd::Client client(options);
    for (graspd::Verdict former, now;; former = now) {
        now = client.verdict(0.02);
        if (now.decision != former.decision || now.reasons != former.reasons ||
            now.boot_id != former.boot_id)
            print(now, client.counts());
    }
}

graspd::Outcome outcome(const std::string& word) {
    if (word == "held" || word == "stable") return graspd::Outcome::held;
    if (word == "slipped" || word == "slip") return graspd::Outcome::slipped;
    if (word == "not-lifted") return graspd::Outcome::not_lifted;
    throw std::invalid_argument("held, slipped or not-lifted");
}

int show(const graspd::OutcomeAnswer& answer) {
    std::cout << (answer ? "taken" : answer.why) << '\n';
    return answer ? 0 : 1;
}

// Reads how the lift ended, until it is an outcome; at the end of the input no lift followed.
graspd::Outcome typed() {
    for (std::string word; std::cin >> word;) {
        try {
            return outcome(word);
        } catch (const std::invalid_argument& error) {
            std::cerr << error.what() << "?\n";
        }
    }
    return graspd::Outcome::not_lifted;
}

int ask(const graspd::Options& options, double deadline_s, bool supervised,
        std::optional<double> still_ms, const std::optional<std::string>& object) {
    if (object) graspd::detail::check_object(*object);  // before a lift that could not be told
    graspd::Client client(options);
    const graspd::LiftAnswer answer = client.may_i_lift(deadline_s, supervised, still_ms);
    print(answer.verdict, client.counts());
    std::cout << (answer ? "lift" : "do not lift") << (answer.supervised ? " supervised" : "")
              << " after " << answer.waited_s << " s"
              << (answer.verdict.owner.empty() ? "" : ", owner: " + answer.verdict.owner) << std::endl;
    if (!answer || !object) return answer ? 0 : 1;
    return show(client.tell(answer.verdict, typed(), *object));
}

int tell(const std::vector<std::string>& words) {
    graspd::Options options;
    options.endpoint = words[1];
    options.ask_endpoint = words[2];
    graspd::Verdict lifted_on;
    lifted_on.boot_id = words[3];
    lifted_on.grasp = number<std::int64_t>(words[4]);
    graspd::Client client(options);
    return show(client.tell(lifted_on, outcome(words[5]), words.size() == 7 ? words[6] : ""));
}

}  // namespace

int main(int count, char** given) {
    std::vector<std::string> words(given + 1, given + count);
    const bool supervised = !words.empty() && words[0] == "--supervised";
    if (supervised) words.erase(words.begin());
    graspd::Options options;
    try {
        std::optional<double> still_ms;
        if (words.size() > 1 && words[0] == "--still") {
            still_ms = number<double>(words[1]);
            words.erase(words.begin(), words.begin() + 2);
        }
        if (!words.empty() && words[0] == "--watch" && (words.size() == 2 || words.size() == 4)) {
            options.endpoint = words[1];
            if (words.size() == 4) options.keys = graspd::Keys::load(words[2], words[3]);
            return watch(options);
        }
        if (!words.empty() && words[0] == "--tell" && (words.size() == 6 || words.size() == 7))
            return tell(words);
        if (words.size() >= 2 && words.size() <= 4) {
            options.endpoint = words[0];
            if (words.size() > 2) options.ask_endpoint = words[2];
            std::optional<std::string> object;
            if (words.size() == 4) object = words[3];
            return ask(options, number<double>(words[1]), supervised, still_ms, object);
        }
    } catch (const std::exception& error) {
        std::cerr << "lift_gate: " << error.what() << '\n';
        return 2;
    }
    std::cerr << "lift_gate [--supervised] [--still MS] ENDPOINT DEADLINE_S [ASK_ENDPOINT [OBJECT]]\n"
                 "lift_gate --tell ENDPOINT ASK_ENDPOINT BOOT_ID GRASP held|slipped [OBJECT]\n"
                 "lift_gate --watch ENDPOINT [SERVER.key OWN.key_secret]\n";
    return 2;
}
